"""Finds the parts of a scene that are optimized: those whose parameters have gradients."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .bsdfs import diffuse_weight
from .media import scene_media
from .parameter_values import values_of

#: Parameters of shapes and sensors that change where rays hit.
_GEOMETRY = ("vertex_positions", "vertex_normals", "vertex_texcoords", "to_world",
             "control_points", "x_fov", "principal_point_offset_x", "principal_point_offset_y",
             "aperture_radius", "focus_distance")  # fmt: skip

#: Names of the roughness of microfacet BSDFs.
_ROUGHNESS = {"alpha", "alpha_u", "alpha_v", "roughness"}


class Distribution(enum.IntEnum):
    """How the normals of the microfacets of a BSDF are distributed."""

    NONE, GGX, BECKMANN = range(3)


def refuse_geometry(plugin: str, params: Any) -> None:
    """
    Parameters:
        plugin: Name of the integrator.
        params: The parameters passed to ``mi.render``, such as the result of ``mi.traverse``.

    Raises:
        NotImplementedError: Gradients with respect to geometry are requested.
    """
    if not (isinstance(params, Mapping) or hasattr(params, "items")):
        return
    for key, value in params.items():
        if str(key).rpartition(".")[2] in _GEOMETRY and dr.grad_enabled(value):
            raise NotImplementedError(
                f'"{plugin}": there are no gradients with respect to "{key}", which changes '
                f'geometry; use "prb" or "prb_projective"'
            )


def has_gradients(*things: mi.Object) -> bool:
    """Whether any parameter of a scene or a sensor has a gradient."""
    return any(dr.grad_enabled(value) for each in things for _, value in mi.traverse(each))


def optimizes_grids(scene: mi.Scene) -> bool:
    """Whether the extinction of a medium that is not homogeneous has a gradient. Media within
    instances are not accessible."""
    return any(
        key.startswith("sigma_t") and dr.grad_enabled(value)
        for medium in scene_media(scene)
        if not medium.is_homogeneous()
        for key, value in values_of(mi.traverse(medium))
    )


def optimized_but_smooth(scene: mi.Scene) -> list[str]:
    """The names of the BSDFs whose parameters have gradients, although all of their light is
    reflected or refracted as by mirrors and smooth glass. Their gradients are 0."""
    bsdfs = {bsdf.ptr: bsdf for shape in scene.shapes() if (bsdf := shape.bsdf()) is not None}
    return sorted(
        bsdf.id()
        for bsdf in bsdfs.values()
        if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
        and not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        and _is_optimized(bsdf)
    )


class RoughBSDFs:
    """The BSDFs of a scene whose roughness has gradients, and that sample visible normals with most
    of their samples. ``roughplastic`` and other BSDFs with strong diffuse lobes do not. BSDFs
    within instances are not accessible.

    Attributes:
        kinds: The :class:`Distribution` of the microfacets of each BSDF, and ``NONE`` for other
            BSDFs; a table over Dr.Jit's indices of BSDFs.
        α: The roughness of each BSDF: of textures, the mean; of several lobes, the largest.
    """

    def __init__(self, found: dict[int, tuple[Distribution, float]]) -> None:
        kinds, α = (np.zeros(max(found) + 1, kind) for kind in (np.uint32, np.float32))
        for index, values in found.items():
            kinds[index], α[index] = values
        self.kinds, self.α = mi.UInt32(kinds), mi.Float(α)
        self._used = {kind for kind, _ in found.values()}

    @classmethod
    def of(cls, scene: mi.Scene) -> RoughBSDFs | None:
        """The rough BSDFs of ``scene``; ``None`` if there are none."""
        found = {}
        for shape in scene.shapes():
            bsdf = shape.bsdf()
            α = 0.0 if bsdf is None or _is_diffuse(bsdf) else _optimized_roughness(bsdf)
            described = str(bsdf)  # with BSDFs that are nested
            if α > 0 and "sample_visible = 0" not in described:
                is_beckmann = "distribution = beckmann" in described
                kind = Distribution.BECKMANN if is_beckmann else Distribution.GGX
                found[_index(mi.BSDFPtr(bsdf))] = kind, α
        return cls(found) if found else None

    def at(self, bsdf: mi.BSDFPtr) -> tuple[mi.UInt32, mi.Float]:
        """The kind and the roughness of ``bsdf``."""
        index = dr.reinterpret_array(mi.UInt32, bsdf)
        is_known = index < dr.width(self.kinds)
        return (
            dr.gather(mi.UInt32, self.kinds, index, is_known),
            dr.gather(mi.Float, self.α, index, is_known),
        )

    def has(self, kind: Distribution) -> bool:
        """Whether any of the BSDFs is of this ``kind``."""
        return kind in self._used


def _is_diffuse(bsdf: mi.BSDF) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse) and diffuse_weight(bsdf) > 0.5


def _optimized_roughness(bsdf: mi.BSDF) -> float:
    """The largest α that has gradients; 0 if none has."""
    largest, parameters = 0.0, mi.traverse(bsdf)
    for key, value in values_of(parameters):
        names = _ROUGHNESS & set(key.split("."))
        if names and dr.grad_enabled(value):
            mean = float(np.mean(np.array(dr.detach(value), np.float64)))
            largest = max(largest, mean**2 if "roughness" in names else mean)
    return largest


class Optimized:
    """The BSDFs, media and lights of a scene that have parameters with gradients.

    Attributes:
        lights_differ (bool): Whether some, but not all, of the lights are optimized.
    """

    def __init__(self, scene: mi.Scene) -> None:
        bsdfs, media, emitters = {}, {}, {}
        for shape in scene.shapes():
            index = _index(mi.BSDFPtr(shape.bsdf()))
            is_known = bsdfs.get(index, False)
            bsdfs[index] = is_known or _is_optimized(shape.bsdf()) or _has_optimized_colours(shape)
        for emitter in scene.emitters():
            emitters[_index(mi.EmitterPtr(emitter))] = _is_optimized(emitter)
        for medium in scene_media(scene):
            media[_index(mi.MediumPtr(medium))] = _is_optimized(medium)
        self.lights_differ = len({*emitters.values()}) == 2
        self._bsdfs, self._emitters = _table(bsdfs), _table(emitters)
        self._media = _table(media)

    def bsdf(self, bsdf: mi.BSDFPtr) -> mi.Float:
        """1 where it is optimized, otherwise 0."""
        return _gathered(self._bsdfs, bsdf)

    def medium(self, medium: mi.MediumPtr) -> mi.Float:
        """1 where it is optimized, otherwise 0."""
        return _gathered(self._media, medium)

    def emitter(self, emitter: mi.EmitterPtr) -> mi.Float:
        """1 where it is optimized, otherwise 0."""
        return _gathered(self._emitters, emitter)


def _is_optimized(thing: Any) -> bool:
    return any(dr.grad_enabled(value) for _key, value in values_of(mi.traverse(thing)))


def _has_optimized_colours(shape: mi.Shape) -> bool:
    """Whether a mesh has attributes with gradients, which its BSDF may use."""
    # Parameters of its BSDF and its light have a prefix and a dot in their names
    values = values_of(mi.traverse(shape))
    return any("." not in key and dr.grad_enabled(value) for key, value in values)


def _index(pointer: mi.BSDFPtr | mi.MediumPtr | mi.EmitterPtr) -> int:
    return int(dr.reinterpret_array(mi.UInt32, pointer)[0])


def _table(flags: Mapping[int, bool]) -> mi.Float:
    # An unknown object, such as one of a shape group, counts as optimized
    table = np.ones(max(flags, default=0) + 1, np.float32)
    table[[*flags]] = [*flags.values()]
    return mi.Float(table)


def _gathered(table: mi.Float, pointer: mi.BSDFPtr | mi.MediumPtr | mi.EmitterPtr) -> mi.Float:
    index = dr.reinterpret_array(mi.UInt32, pointer)
    is_known = index < len(table)
    return dr.select(is_known, dr.gather(mi.Float, table, index, is_known), 1)
