"""The names of the objects and materials of a scene, which are the same in every process.

Mitsuba loads the shapes of a file in parallel. Their order in ``scene.shapes()`` and Dr.Jit's
numbers of them differ from run to run, so a name comes from the file:

- A shape has the ``id`` of its element (the key in a dict). An instance is one object, with the
  ``id`` of the instance. A shape without ``id`` in a ``moving`` has the ``id`` of that.
- Without an ``id``, the name is the file or the type of the shape. Shapes that would have the same
  name get numbers, in the order of their bounding boxes.
- A BSDF has its ``id``, or the ``id`` of a BSDF nested in it. If there is none, or several BSDFs
  have the same one (``bsdf`` in many dicts), the name of the first of its shapes precedes it.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy
from .bsdfs import bsdf_table
from .lightweight_shapes import surface


class SurfaceNames(NamedTuple):
    """The names of what rays can meet in a scene, in alphabetic order. The number of a name is its
    position in this order, from 1 on. Number 0 stands for nothing.

    Attributes:
        objects, materials: The names.
        object_numbers: The number of the object, by Dr.Jit's number of the shape.
        material_numbers: The number of the material, by Dr.Jit's number of the BSDF.
        transparent: By Dr.Jit's number of a BSDF, whether light can pass it straight on, as through
            an opacity mask; ``None`` if there is no such BSDF.
        has_instances: Whether the scene has instances.
        merged: The name of a mesh that Mitsuba merged from meshes whose names are lost; empty if
            there is none.
    """

    objects: tuple[str, ...]
    materials: tuple[str, ...]
    object_numbers: mi.UInt32
    material_numbers: mi.UInt32
    transparent: mi.Bool | None
    has_instances: bool
    merged: str


class _Object(NamedTuple):
    """Something with a name. ``surfaces`` are the shapes that rays find in its place."""

    name: str
    shape: mi.Shape
    surfaces: tuple[mi.Shape, ...]


def surface_names(scene: mi.Scene) -> SurfaceNames:
    """The names of the objects and materials of ``scene``."""
    objects = list(_objects(scene.shapes()))
    names = _distinct([each.name for each in objects], lambda index: objects[index].shape)
    ordered = sorted(set(names))
    position = {name: index + 1 for index, name in enumerate(ordered)}
    numbers = [
        (_number(each, mi.ShapePtr), position[name])
        for name, found in zip(names, objects)
        for each in found.surfaces
    ]
    bsdfs = _materials([*zip(names, objects), *_in_groups(scene)])
    materials = sorted(set(bsdfs.values()))
    position = {name: index + 1 for index, name in enumerate(materials)}
    return SurfaceNames(
        tuple(ordered), tuple(materials), _table(numbers),
        _table([(_number(bsdf, mi.BSDFPtr), position[name]) for bsdf, name in bsdfs.items()]),
        _transparent(scene, list(bsdfs)),
        any(each.shape.class_name() == "Instance" for each in objects),
        next((each.name for each in objects if _is_merged(each.shape)), ""),
    )  # fmt: skip


def _objects(shapes: Sequence[mi.Shape], mover: str = "") -> Iterator[_Object]:
    """The objects among shapes. ``mover`` is the name of the ``moving`` in which they are."""
    for shape in shapes:
        if shape.class_name() == "ShapeGroupPlugin":  # visible through instances only
            continue
        if children := getattr(shape, "children", ()):
            yield from _objects(children, shape.id())
        else:
            inner = surface(shape)
            name = shape.id() or inner.id() or mover or _kind(inner)
            yield _Object(name, shape, (shape, inner))


def _in_groups(scene: mi.Scene) -> list[tuple[str, _Object]]:
    """The shapes of groups, from which materials may get their names, with names."""
    found = []
    for group in _nested(scene, "ShapeGroupPlugin"):
        inside = [each for each in _nested(group) if isinstance(each, mi.Shape)]
        found += [_Object(f"{group.id()}.{each.id() or _kind(each)}", each, ()) for each in inside]
    return list(zip(_distinct([each.name for each in found], lambda i: found[i].shape), found))


def _nested(parent: mi.Object, class_name: str = "") -> list[mi.Object]:
    """The objects that an object holds, also those in its ``moving`` shapes."""

    # Defined here because the base class exists only once a variant is selected
    class Nested(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[mi.Object] = []

        def put(self, _name: str, value: object, _flags: int, *_more: object) -> None:
            for each in (value, *getattr(value, "children", ())):
                if isinstance(each, mi.Object) and each.class_name().startswith(class_name):
                    self.found.append(each)

    nested = Nested()
    parent.traverse(nested)
    return nested.found


def _kind(shape: mi.Shape) -> str:
    """The file of a mesh, or the type of another shape."""
    name = re.match(r'\w+\[\s*name = "([^"]*)"', str(shape)) if shape.is_mesh() else None
    return (name and name[1]) or shape.class_name().lower()


def _is_merged(shape: mi.Shape) -> bool:
    """Whether Mitsuba merged meshes to this one, and it has no name of its own."""
    return shape.class_name() == "Mesh" and not shape.id() and " + " in _kind(shape)


def _distinct(names: Sequence[str], shape_of: Callable[[int], mi.Shape]) -> list[str]:
    """The names, with numbers where several are the same. The numbers follow the bounding boxes of
    the shapes, because the order in which Mitsuba lists shapes is random."""
    alike = defaultdict(list)
    for index, name in enumerate(names):
        alike[name].append(index)
    taken, distinct = set(alike), list(names)
    for name in sorted(alike):
        if len(alike[name]) == 1:
            continue
        number = 0
        for index in sorted(alike[name], key=lambda i: _place(shape_of(i))):
            number += 1
            while f"{name}_{number}" in taken:
                number += 1
            distinct[index] = f"{name}_{number}"
    return distinct


def _place(shape: mi.Shape) -> tuple:
    """What orders shapes without names: their bounding box, and their vertices if that is equal."""
    box, content = shape.bbox(), ""
    if shape.is_mesh():
        positions = np.array(shape.vertex_positions_buffer())
        content = hashlib.sha256(positions.tobytes()).hexdigest()
    return (*box.min, *box.max, shape.class_name(), content)


def _materials(objects: Sequence[tuple[str, _Object]]) -> dict[mi.BSDF, str]:
    """The names of all BSDFs."""
    owners: dict[mi.BSDF, list[str]] = defaultdict(list)
    for name, found in objects:
        if found.shape.class_name() == "Instance":  # has a BSDF that nobody sees
            continue
        if (bsdf := surface(found.shape).bsdf()) is not None:
            owners[bsdf].append(name)
    ids = {bsdf: _id(bsdf) for bsdf in owners}
    known = Counter(ids.values())
    return {
        bsdf: name
        if (name := ids[bsdf]) and known[name] == 1
        else f"{min(owners[bsdf])}.{name or 'bsdf'}"
        for bsdf in owners
    }


def _id(bsdf: mi.BSDF) -> str:
    """The name of a BSDF, or of the first one that is nested in it; empty without any."""
    inner = (each for each in _nested(bsdf) if isinstance(each, mi.BSDF))
    return bsdf.id() or next(filter(None, map(_id, inner)), "")


def _transparent(scene: mi.Scene, bsdfs: Sequence[mi.BSDF]) -> mi.Bool | None:
    # What is behind a pane of glass is seen through it, but the pane is what covers the pixel
    glass = bsdf_table(scene, ("ThinDielectric",))
    glass = np.zeros(0, bool) if glass is None else glass.numpy()
    table = {}
    for bsdf in bsdfs:
        number = _number(bsdf, mi.BSDFPtr)
        is_glass = number < len(glass) and glass[number]
        table[number] = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) and not is_glass
    if not any(table.values()):
        return None
    values = np.zeros(max(table) + 1, bool)
    values[list(table)] = list(table.values())
    return from_numpy(mi.Bool, values)


def _number(value: mi.Object, kind: type) -> int:
    return int(dr.reinterpret_array(mi.UInt32, kind(value))[0])


def _table(numbers: Sequence[tuple[int, int]]) -> mi.UInt32:
    values = np.zeros(max((key for key, _value in numbers), default=0) + 1, np.uint32)
    for key, value in numbers:
        values[key] = value
    return from_numpy(mi.UInt32, values)
