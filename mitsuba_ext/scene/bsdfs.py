"""Finds BSDFs in scenes, even nested ones, and refuses BSDFs that light paths cannot render."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy
from .media import has_instances
from .movers import all_shapes

#: BSDFs that perturb normals, as they appear in ``str(bsdf)``.
_BUMPED = ("BumpMap[", "NormalMap[")

#: Mitsuba's BSDFs that ignore the ``type_mask`` of a context when they are evaluated.
_UNDIVIDED = ("Principled", "PrincipledThin")


def bsdf_table(scene: mi.Scene, classes: Collection[str]) -> mi.Bool | None:
    """Which BSDFs of ``scene`` are, or contain, one of the ``classes``: a table over Dr.Jit's
    indices of BSDFs. ``None`` if no BSDF does. The BSDFs of an instance are not accessible: if the
    scene has an instance, all BSDFs in memory are examined."""
    found = [_index(bsdf) for bsdf in all_bsdfs(scene) if contains_bsdf(bsdf, classes)]
    if not found:
        return None
    table = np.zeros(max(found) + 1, bool)
    table[found] = True
    return mi.Bool(table)


def is_in_table(table: mi.Bool, bsdf: mi.BSDFPtr) -> mi.Bool:
    """Whether ``bsdf`` is one of the BSDFs that :func:`bsdf_table` has found."""
    index = dr.reinterpret_array(mi.UInt32, bsdf)
    return dr.gather(mi.Bool, table, index, index < dr.width(table))


def opaque_bsdfs(scene: mi.Scene) -> mi.Bool:
    """Which BSDFs reflect only light from the side of the shading normal that is seen: a table over
    Dr.Jit's indices of BSDFs. False for BSDFs that are not found here (in instances), and for bump
    and normal maps, whose normals may face away."""
    transmission = int(mi.BSDFFlags.Transmission)
    bsdfs = {shape.bsdf() for shape in scene.shapes() if shape.bsdf() is not None}
    found = [
        _index(bsdf) for bsdf in bsdfs
        if not int(bsdf.flags()) & transmission
        and not any(name in str(bsdf) for name in _BUMPED)
    ]  # fmt: skip
    table = np.zeros(max(found, default=0) + 1, bool)
    table[found] = True
    return from_numpy(mi.Bool, table)


def has_glossy_lobes(scene: mi.Scene) -> bool:
    """Whether a BSDF of the scene has glossy lobes."""
    glossy = int(mi.BSDFFlags.Glossy)
    return any(int(bsdf.flags()) & glossy for bsdf in all_bsdfs(scene))


def mixes_lobes(scene: mi.Scene) -> bool:
    """Whether a BSDF of the scene has both diffuse and glossy lobes."""
    diffuse, glossy = int(mi.BSDFFlags.Diffuse), int(mi.BSDFFlags.Glossy)
    flags = [int(bsdf.flags()) for bsdf in all_bsdfs(scene)]
    return any(f & diffuse and f & glossy for f in flags)


def undivided_bsdfs(scene: mi.Scene) -> mi.Float | None:
    """For BSDFs that are, or contain, a ``principled`` or ``principledthin``: the weight of its
    diffuse lobes (the mean over a texture). It is a table over Dr.Jit's indices of BSDFs, negative
    for other BSDFs; ``None`` if there are only others."""
    found = (bsdf for bsdf in all_bsdfs(scene) if contains_bsdf(bsdf, _UNDIVIDED))
    weights = {_index(bsdf): diffuse_weight(bsdf) for bsdf in found}
    if not weights:
        return None
    table = np.full(max(weights) + 1, -1.0)
    table[list(weights)] = list(weights.values())
    return from_numpy(mi.Float, table)


def diffuse_weight(bsdf: mi.BSDF) -> float:
    """(1 − metallic) (1 − spec_trans), by the names of the parameters; 1 for BSDFs without them."""
    weight, parameters = 1.0, mi.traverse(bsdf)
    for key in parameters.keys():
        if {"metallic", "spec_trans"} & set(key.split(".")):
            values = np.array(parameters[key], float)
            weight *= 1 - float(values.mean()) if values.size else 1
    return weight


def has_clear_curves(scene: mi.Scene) -> bool:
    """Whether light passes through a curve, such as one with the BSDF ``hair``.

    No ray hits a curve from inside. A camera path leaves a curve without an intersection: its only
    vertex is the entry point. The reverse light path meets the other side of the curve instead.

    The shapes of instances are not accessible: with one, all shapes in memory are examined."""
    F = mi.BSDFFlags
    shapes = list(all_shapes(scene.shapes()))
    if has_instances(scene):
        shapes += all_in_memory(mi.ShapePtr)
    transmits = int(F.DiffuseTransmission) | int(F.GlossyTransmission) | int(F.DeltaTransmission)
    return any(
        shape.class_name() in ("BSplineCurve", "LinearCurve")
        and shape.bsdf() is not None
        and bool(int(shape.bsdf().flags()) & transmits)
        for shape in shapes
    )


def refuse_clear_curves(scene: mi.Scene, what: str) -> None:
    """Raises an error if light passes through a curve, for methods whose light paths must meet it.

    Parameters:
        what: The beginning of the message, which names the plugin.

    Raises:
        NotImplementedError: :func:`has_clear_curves` is true.
    """
    if has_clear_curves(scene):
        raise NotImplementedError(
            f'{what}: light paths do not pass through a "bsplinecurve" or "linearcurve" whose BSDF '
            f'transmits light, such as "hair": use "bdpt" or "composed_path", or a mesh instead of '
            f"the curve."
        )


def all_bsdfs(scene: mi.Scene) -> set[mi.BSDF]:
    """The BSDFs of a scene; with an instance, whose BSDFs are not accessible, all in memory."""
    shapes = all_shapes(scene.shapes())
    bsdfs = {shape.bsdf() for shape in shapes if shape.bsdf() is not None}
    return bsdfs.union(all_in_memory(mi.BSDFPtr) if has_instances(scene) else ())


def contains_bsdf(bsdf: mi.BSDF, classes: Collection[str]) -> bool:
    """Whether ``bsdf`` is, or contains, one of the ``classes``."""
    if bsdf.class_name() in classes:
        return True

    # Defined here because the base class exists only once a variant is selected
    class Nested(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.is_found = False

        def put(self, _name: str, value: object, _flags: int, *_more: object) -> None:
            self.is_found |= isinstance(value, mi.BSDF) and contains_bsdf(value, classes)

    nested = Nested()
    bsdf.traverse(nested)
    return nested.is_found


def all_in_memory(kind: type) -> Iterator[mi.Object]:
    """The objects that arrays of pointers of this ``kind`` can refer to."""
    for index in itertools.count(1):
        try:
            found = dr.reinterpret_array(kind, mi.UInt32(index))[0]
        except RuntimeError:  # no index from here on was ever in use
            return
        if found is not None:  # the object of this index is not deleted
            yield found


def _index(bsdf: mi.BSDF) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])
