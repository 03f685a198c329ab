"""Finds BSDFs in scenes, also where others contain them, and raises errors for those that light
paths cannot render."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from .movers import all_shapes

#: How many of Dr.Jit's indices of BSDFs are examined in scenes with instances.
_NUMBERS = 1024


def bsdf_table(scene: mi.Scene, classes: Collection[str]) -> mi.Bool | None:
    """Which BSDFs of ``scene`` are, or contain, one of the ``classes``: a table over Dr.Jit's
    indices of BSDFs. ``None`` if there is none. The BSDFs of an instance are not accessible: where
    there is one, all BSDFs in memory are examined."""
    shapes = list(all_shapes(scene.shapes()))
    bsdfs = [shape.bsdf() for shape in shapes if shape.bsdf() is not None]
    if any(shape.class_name() == "Instance" for shape in shapes):
        bsdfs += _all_in_memory()
    found = [_index(bsdf) for bsdf in set(bsdfs) if _contains(bsdf, classes)]
    if not found:
        return None
    table = np.zeros(max(found) + 1, bool)
    table[found] = True
    return mi.Bool(table)


def is_in_table(table: mi.Bool, bsdf: mi.BSDFPtr) -> mi.Bool:
    """Is ``bsdf`` one of those that :func:`bsdf_table` has found?"""
    index = dr.reinterpret_array(mi.UInt32, bsdf)
    return dr.gather(mi.Bool, table, index, index < dr.width(table))


def has_clear_curves(scene: mi.Scene) -> bool:
    """Does light pass through a curve, such as one with the BSDF ``hair``?

    No ray hits a curve from inside. A camera path that enters a curve leaves it unseen: its vertex
    is where it enters. The reverse light path meets the other side of the curve instead."""
    F = mi.BSDFFlags
    transmits = int(F.DiffuseTransmission) | int(F.GlossyTransmission) | int(F.DeltaTransmission)
    return any(
        shape.class_name() in ("BSplineCurve", "LinearCurve")
        and shape.bsdf() is not None
        and bool(int(shape.bsdf().flags()) & transmits)
        for shape in all_shapes(scene.shapes())
    )


def refuse_clear_curves(scene: mi.Scene, what: str) -> None:
    """Raises an error if light passes through a curve. For methods that need light paths to find
    it.

    Parameters:
        what: The beginning of the message: the plugin.

    Raises:
        NotImplementedError: :func:`has_clear_curves`.
    """
    if has_clear_curves(scene):
        raise NotImplementedError(
            f'{what}: light paths do not pass through a "bsplinecurve" or "linearcurve" whose BSDF '
            f'transmits light, such as "hair": use "bdpt" or "composed_path", or a mesh instead of '
            f"the curve."
        )


def _contains(bsdf: mi.BSDF, classes: Collection[str]) -> bool:
    if bsdf.class_name() in classes:
        return True

    # Defined here, since the base class only exists once a variant is selected
    class Nested(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.is_found = False

        def put(self, _name: str, value: object, _flags: int, *_more: object) -> None:
            self.is_found |= isinstance(value, mi.BSDF) and _contains(value, classes)

    nested = Nested()
    bsdf.traverse(nested)
    return nested.is_found


def _all_in_memory() -> Iterator[mi.BSDF]:
    for index in range(1, _NUMBERS):
        try:
            bsdf = dr.reinterpret_array(mi.BSDFPtr, mi.UInt32(index))[0]
        except RuntimeError:  # an index that was never in use
            continue
        if bsdf is not None:
            yield bsdf


def _index(bsdf: mi.BSDF) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])
