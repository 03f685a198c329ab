"""The symbols of a scene: what can happen to light at its surfaces, in its media and at its
lights."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.errors import did_you_mean
from ..bsdfs import all_in_memory
from ..light_groups import light_group, light_name
from ..media import has_instances
from ..movers import all_shapes
from .notation import Expression, Symbol

#: The symbols of a vertex on a surface without labels; symbols of other surfaces repeat them.
SURFACE = [Symbol(type_, scattering) for type_ in "RT" for scattering in "DGS"]

#: Symbols of a class of surfaces: those above, and two that do not depend on the surface.
PER_CLASS = 8
VOLUME, STRAIGHT = 6, 7

_BASE = [*SURFACE, Symbol("V"), Symbol("T", "s")]

#: The symbols of all kinds of lights, without labels.
LIGHTS = [Symbol("LO"), Symbol("LB"), Symbol("L")]


@dataclass
class Alphabet:
    """The symbols of a scene, for some expressions.

    Attributes:
        vertices: The symbols of vertices: ``PER_CLASS`` for each class of surfaces.
        lights: The symbols of lights.
        light_class: The symbol of each light, by Dr.Jit's index of its pointer.
        surface_class: The class of each shape, by its index; ``None`` if all are in class 0.
    """

    vertices: list[Symbol]
    lights: list[Symbol]
    light_class: mi.UInt32
    surface_class: mi.UInt32 | None

    @classmethod
    def of(cls, scene: mi.Scene, expressions: Iterable[Expression]) -> Alphabet:
        """The symbols that ``expressions`` tell apart in ``scene``.

        Raises:
            ValueError: Nothing in the scene has a label that occurs in an expression.
        """
        expressions = list(expressions)
        labels = frozenset().union(*(expression.labels for expression in expressions))
        shapes = list(all_shapes(scene.shapes()))
        if has_instances(scene):
            shapes += list(all_in_memory(mi.ShapePtr))
        named = [(shape, _names(shape)) for shape in shapes]
        emitters = scene.emitters()
        known = {name for emitter in emitters for name in _light_labels(emitter)}
        known.update(name for _shape, names in named for name in names)
        for expression in expressions:
            for label in sorted(expression.labels - known):
                raise ValueError(
                    f'the expression "{expression.text}" has the label "{label}", but no light, '
                    f"shape or BSDF of the scene has this name"
                    f"{did_you_mean(label, known) or _listed(known)}. Mitsuba merges meshes of one "
                    f"BSDF when it loads a scene: name the BSDF, or load it with optimize=False"
                )
        lights = [Symbol(_light_types(e), "", _light_labels(e) & labels) for e in emitters]
        symbols = sorted(set(lights), key=lambda s: (s.types, sorted(s.labels))) or LIGHTS
        pointers = [mi.EmitterPtr(emitter) for emitter in emitters]
        light_class = _table(pointers, [symbols.index(light) for light in lights])
        found = {names & labels for _shape, names in named} - {frozenset()}
        classes = [frozenset(), *sorted(found, key=sorted)]
        surface_class = None
        if len(classes) > 1:
            surface_class = _table(
                [mi.ShapePtr(shape) for shape, _names in named],
                [classes.index(names & labels) for _shape, names in named],
            )
        vertices = [
            Symbol(base.types, base.scattering, found if base in SURFACE else frozenset())
            for found in classes
            for base in _BASE
        ]
        return cls(vertices, symbols, light_class, surface_class)


def can_be_met(expression: Expression) -> bool:
    """Whether any path of any scene belongs to an expression."""
    from .automaton import Automaton

    vertices = [Symbol(s.types, s.scattering, expression.labels) for s in _BASE] + _BASE
    lights = [Symbol(s.types, "", expression.labels) for s in LIGHTS] + LIGHTS
    automaton = Automaton.of([expression], vertices, lights)
    return len(automaton.cells) > 1 and bool(automaton.ends.any())


def _light_types(emitter: mi.Emitter) -> str:
    if emitter.get_shape() is not None:
        return "LO"
    return "LB" if emitter.is_environment() else "L"


def _light_labels(emitter: mi.Emitter) -> frozenset[str]:
    return frozenset({light_name(emitter), light_group(emitter)} - {""})


def _names(shape: mi.Shape) -> frozenset[str]:
    names = {shape.id()}
    if shape.bsdf() is not None:
        names.add(shape.bsdf().id())
    return frozenset(names - {""})


def _table(pointers: Sequence[object], values: Collection[int]) -> mi.UInt32:
    """A table over Dr.Jit's indices of objects."""
    indices = [int(dr.reinterpret_array(mi.UInt32, pointer)[0]) for pointer in pointers]
    table = np.zeros(max(indices, default=0) + 1, np.uint32)
    table[indices] = list(values)
    return from_numpy(mi.UInt32, table)


def _listed(names: Collection[str]) -> str:
    if not names:
        return ""
    shown = sorted(names)[:12]
    return f' (it has {", ".join(shown)}{", …" if len(names) > len(shown) else ""})'
