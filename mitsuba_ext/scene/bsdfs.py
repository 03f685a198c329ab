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


def bsdf_table(scene: mi.Scene, classes: Collection[str]) -> mi.Bool | None:
    """Which BSDFs of ``scene`` are, or contain, one of the ``classes``: a table over Dr.Jit's
    indices of BSDFs. ``None`` if no BSDF does. The BSDFs of an instance are not accessible: if the
    scene has an instance, all BSDFs in memory are examined."""
    shapes = all_shapes(scene.shapes())
    bsdfs = [shape.bsdf() for shape in shapes if shape.bsdf() is not None]
    if has_instances(scene):
        bsdfs += _all_in_memory(mi.BSDFPtr)
    found = [_index(bsdf) for bsdf in set(bsdfs) if contains_bsdf(bsdf, classes)]
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


def has_clear_curves(scene: mi.Scene) -> bool:
    """Whether light passes through a curve, such as one with the BSDF ``hair``.

    No ray hits a curve from inside. A camera path leaves a curve without an intersection: its only
    vertex is the entry point. The reverse light path meets the other side of the curve instead.

    The shapes of instances are not accessible: with one, all shapes in memory are examined."""
    F = mi.BSDFFlags
    shapes = list(all_shapes(scene.shapes()))
    if has_instances(scene):
        shapes += _all_in_memory(mi.ShapePtr)
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


def _all_in_memory(kind: type) -> Iterator[mi.Object]:
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
