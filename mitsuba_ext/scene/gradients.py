"""Finds the parts of a scene that are optimized: those whose parameters have gradients."""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy
from .bsdfs import all_bsdfs, bsdf_table, contains_bsdf, diffuse_weight
from .media import has_instances, may_have_media, scene_media
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


def refuse_geometry(plugin: str, keys: Collection[str]) -> None:
    """
    Parameters:
        plugin: Name of the integrator.
        keys: The names of the parameters that have gradients.

    Raises:
        NotImplementedError: Gradients with respect to geometry are requested.
    """
    for key in keys:
        if key.rpartition(".")[2] in _GEOMETRY:
            raise NotImplementedError(
                f'"{plugin}": there are no gradients with respect to "{key}", which changes '
                f'geometry; use "prb" or "prb_projective"'
            )


def has_roughness(keys: Collection[str]) -> bool:
    """Whether any of the parameters with these names is the roughness of a BSDF."""
    return any(_ROUGHNESS & set(key.split(".")) for key in keys)


def optimized_parameters(params: Any) -> dict[str, Any]:
    """The parameters that have gradients, among those that were passed to ``mi.render``."""
    items = params.items() if hasattr(params, "items") else ()
    return {str(key): value for key, value in items if dr.grad_enabled(value)}


def without_gradients(params: Any) -> list[str]:
    """The names of the parameters that should have received a gradient, but have not. None while a
    user records a whole step (``dr.freeze``), when no array can be read."""
    if dr.flag(dr.JitFlag.FreezingScope):
        return []
    return sorted(
        key for key, value in optimized_parameters(params).items()
        if not dr.any(dr.ravel(dr.grad(value)) != 0)
    )  # fmt: skip


def has_gradients(*things: mi.Object) -> bool:
    """Whether any parameter of a scene or a sensor has a gradient."""
    return any(dr.grad_enabled(value) for each in things for _, value in mi.traverse(each))


def has_gaps(scene: mi.Scene) -> bool:
    """Whether a medium is optimized that may scatter nothing somewhere: it has the extinction of a
    grid, or an albedo or an extinction of 0 (which cannot be found out while a user records a whole
    step). Media within instances are not accessible."""
    can_read = not dr.flag(dr.JitFlag.FreezingScope)
    return any(
        key.startswith(("sigma_t", "albedo")) and dr.grad_enabled(value)
        and (_is_grid(medium, key) or (can_read and dr.any(dr.ravel(value) == 0)))
        for medium in scene_media(scene)
        for key, value in values_of(mi.traverse(medium))
    )  # fmt: skip


def _is_grid(medium: mi.Medium, key: str) -> bool:
    return key.startswith("sigma_t") and not medium.is_homogeneous()


def optimizes_media(scene: mi.Scene) -> bool:
    """Whether a medium may have a parameter with gradients."""
    # Media within instances are not accessible
    is_hidden = has_instances(scene) and may_have_media(scene)
    return is_hidden or any(_is_optimized(medium) for medium in scene_media(scene))


def optimizes_mirrors(scene: mi.Scene) -> bool:
    """Whether a BSDF that reflects or transmits light as mirrors, smooth glass and masks do, or a
    part of whose light they do, has parameters with gradients."""
    coloured = [shape.bsdf() for shape in scene.shapes() if _has_optimized_colours(shape)]
    optimized = coloured + [bsdf for bsdf in all_bsdfs(scene) if _is_optimized(bsdf)]
    return any(bsdf is not None and _has_mirror(bsdf) for bsdf in optimized)


def masked_mirrors(scene: mi.Scene) -> mi.Bool | None:
    """Which BSDFs contain a mask (:func:`bsdf_table`); ``None`` if no mask around a mirror is
    optimized."""
    if not any(_is_mirror(bsdf) and _is_optimized(bsdf, "opacity") for bsdf in all_bsdfs(scene)):
        return None
    return bsdf_table(scene, ("MaskBSDF",))


def doubtful_gradients(scene: mi.Scene) -> Iterator[str]:
    """Sentences on BSDFs with gradients that differ from the image's own, or are missing."""
    blends, panes, leaves, names = [], [], [], _Names(scene)
    for bsdf in all_bsdfs(scene):
        if not _has_mirror(bsdf) or not _is_optimized(bsdf):
            continue
        is_mixed = _is_mirror(bsdf) and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        if is_mixed and contains_bsdf(bsdf, ("BlendBSDF",)):
            blends += names.of(bsdf)
        if contains_bsdf(bsdf, ("MaskBSDF",)) and _is_optimized(bsdf, "opacity"):
            leaves += names.of(bsdf, "opacity")
            if contains_bsdf(bsdf, ("ThinDielectric",)):
                panes += names.of(bsdf, "opacity")
    if blends:
        yield (
            f"the gradients of {_listed(blends)} differ from the image: a blendbsdf that contains "
            f"a mirror has the wrong brightness in Mitsuba. Blend rough BSDFs instead"
        )
    if panes:
        yield (
            f"the gradients of {_listed(panes)} are wrong if the thindielectric in the mask is "
            f"optimized, too"
        )
    if leaves and may_have_media(scene):
        yield (
            f"in scenes with media, the gradients of {_listed(leaves)} lack the light that reaches "
            f"a vertex through the mask"
        )


def _has_mirror(bsdf: mi.BSDF) -> bool:
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)


def _is_mirror(bsdf: mi.BSDF) -> bool:
    """Like :func:`_has_mirror`, but false for masks of what is none."""
    flags = bsdf.flags()
    kinds = mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission
    return any(mi.has_flag(flags, kind) for kind in kinds)


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))


class _Names:
    """The names of parameters with gradients, as ``mi.traverse`` prints them."""

    def __init__(self, scene: mi.Scene) -> None:
        parameters = mi.traverse(scene)
        self._parents = {node.ptr: parent for node, (parent, _) in parameters.hierarchy.items()}
        self._nodes = {
            key: parameters.properties[key][2] for key, value in values_of(parameters)
            if dr.grad_enabled(value)
        }  # fmt: skip

    def of(self, thing: mi.Object, name: str = "") -> list[str]:
        """The parameters (of this ``name``) of ``thing``, and of what is nested in it."""
        return [
            key for key, node in self._nodes.items()
            if self._is_within(node, thing) and (not name or name in key.split("."))
        ]  # fmt: skip

    def _is_within(self, node: mi.Object | None, thing: mi.Object) -> bool:
        while node is not None and node.ptr != thing.ptr:
            node = self._parents[node.ptr]
        return node is not None


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
        self.kinds, self.α = from_numpy(mi.UInt32, kinds), from_numpy(mi.Float, α)
        self._used = {kind for kind, _ in found.values()}

    @classmethod
    def of(cls, scene: mi.Scene) -> RoughBSDFs | None:
        """The rough BSDFs of ``scene``; ``None`` if there are none."""
        found = {}
        for shape in scene.shapes():
            bsdf = shape.bsdf()
            α = 0.0 if bsdf is None or _is_diffuse(bsdf) else _optimized_roughness(bsdf)
            described = str(bsdf) if α > 0 else ""  # with BSDFs that are nested
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
            mean = float(dr.slice(dr.mean(dr.ravel(dr.detach(value)))))
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


def _is_optimized(thing: Any, name: str = "") -> bool:
    """Whether it has a parameter (of this ``name``) with gradients."""
    return any(
        dr.grad_enabled(value)
        for key, value in values_of(mi.traverse(thing))
        if not name or name in key.split(".")
    )


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
    return from_numpy(mi.Float, table)


def _gathered(table: mi.Float, pointer: mi.BSDFPtr | mi.MediumPtr | mi.EmitterPtr) -> mi.Float:
    index = dr.reinterpret_array(mi.UInt32, pointer)
    is_known = index < len(table)
    return dr.select(is_known, dr.gather(mi.Float, table, index, is_known), 1)
