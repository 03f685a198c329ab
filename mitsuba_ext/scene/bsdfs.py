"""Finds BSDFs of some classes in scenes, also where others contain them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

#: How many of Dr.Jit's indices of BSDFs are examined in scenes with instances.
_NUMBERS = 1024


def bsdf_table(scene: mi.Scene, classes: Collection[str]) -> mi.Bool | None:
    """Which BSDFs of ``scene`` are, or contain, one of the ``classes``: a table over Dr.Jit's
    indices of BSDFs. ``None`` if there is none. The BSDFs of an instance are not accessible: where
    there is one, all BSDFs in memory are examined."""
    shapes = list(_all(scene.shapes()))
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


def _all(shapes: Iterable[mi.Shape]) -> Iterator[mi.Shape]:
    """The shapes, and the shapes of which moving ones consist."""
    for shape in shapes:
        yield shape
        yield from _all(getattr(shape, "children", ()))


def _all_in_memory() -> Iterator[mi.BSDF]:
    for index in range(1, _NUMBERS):
        try:
            yield dr.reinterpret_array(mi.BSDFPtr, mi.UInt32(index))[0]
        except RuntimeError:  # an index that is not in use
            continue


def _index(bsdf: mi.BSDF) -> int:
    return int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])
