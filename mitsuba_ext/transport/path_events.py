"""Light path expressions in the random walk: each path keeps the state of the automaton that reads
its events (``scene/expressions``) in tables (``event_tables.py``).

**What an event is.** Media scatter with ``V``. At a surface, the two directions give the type:
``R`` if they are on one side of the surface, otherwise ``T``. The lobe gives the scattering. Delta
lobes (``S``, or ``s`` where light goes straight on) are found by sampling only, so that the lobe is
known. Other lobes are found in two ways: by sampling, and by connections, which evaluate all lobes
together. MIS weights are for the sum of the lobes. What is diffuse about a pair of directions must
therefore follow from this pair alone: it is the share of the diffuse lobes in the value of the BSDF
(:func:`.bsdfs.diffuse_share`), for each colour.

- A connection is divided by this share, and belongs to two cells.
- A sampled direction cannot be divided: the path goes on with one state. It chooses one. Each
  colour takes ``D`` with the probability of its share, and otherwise ``G``. All colours use the
  same random number. The expected channel is the same as if the path had been divided, each colour
  has its full value in one of the channels, and MIS weights are right because the probability is a
  function of the two directions.

Channels are thus what a scene without the other lobes would show, with the same sampling, and a
partition of all paths adds up to the image, sample by sample.

Random numbers come from a hash of the position and the direction. The sampler's numbers, and with
them the image, are the same as without expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scene.bsdfs import has_glossy_lobes, mixes_lobes, undivided_bsdfs
from ..scene.expressions.alphabet import Alphabet
from ..scene.expressions.automaton import Automaton
from ..scene.expressions.notation import Expression
from ..util.arrays import from_numpy
from .bsdfs import DiffuseLobes, diffuse_share
from .event_tables import (
    COLUMNS,
    DIFFUSE,
    GLOSSY,
    KINDS,
    PASSES,
    SCATTERS,
    SPECULAR,
    TRANSMITS,
    EventTables,
    depends_on_lobe,
    states_in,
)
from .heroes import Heroes
from .vertex import MediumVertex, PathState, Vertex


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class PathEvents:
    """Follows the events of camera paths and light paths. The state of a path is a list: one state
    for all colours, or a state for each of them. A path belongs to a *cell* of the automaton, the
    set of its expressions; cell 0 is none.

    Parameters:
        scene: The scene.
        expressions: The expressions.

    Raises:
        ValueError: A label of an expression is not in the scene, or the expressions are too
            complex.
    """

    def __init__(self, scene: mi.Scene, expressions: Sequence[Expression]) -> None:
        alphabet = Alphabet.of(scene, expressions)
        automaton = Automaton.of(expressions, alphabet.vertices, alphabet.lights)
        self._surface_class = alphabet.surface_class
        self.cells = automaton.cells
        self._tables = tables = EventTables(automaton)
        light_class = tables.light_class[alphabet.light_class.numpy()]
        self._light_class = from_numpy(mi.UInt32, light_class) if light_class.any() else None
        self._sees_lobes = has_glossy_lobes(scene) and tables.tell_lobes_apart
        self._mixes = self._sees_lobes and mixes_lobes(scene)
        self._undivided = undivided_bsdfs(scene) if self._mixes else None
        heroes = Heroes(scene)
        self._ctx, self._disperses = heroes.context(), heroes.are_needed

    @property
    def colours(self) -> int:
        """The number of states of a path."""
        return len(mi.UnpolarizedSpectrum()) if self._mixes else 1

    # ---- Along a camera path ----

    def begin(self) -> list[mi.UInt32]:
        """The state before the first vertex."""
        return [mi.UInt32(0) for _ in range(self.colours)]

    def left(
        self, vertex: Vertex, bs: mi.BSDFSample3f, weight: mi.Spectrum, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state behind ``vertex``, in the direction ``bs`` that was sampled there. ``weight``
        is the BSDF's value in this direction / density."""
        if not self._tables.reads:
            return vertex.path.events
        known = vertex.lobes and vertex.lobes.sampled
        return self._sampled(self._tables.steps, vertex, bs, bs.wo, weight * bs.pdf, active, known)

    def at_light(self, path: PathState, emitter: mi.EmitterPtr) -> list[mi.UInt32]:
        """The cells of a path that hits a light."""
        return self._tables.ended(path.events, _looked_up(self._light_class, emitter))

    def at_connection(
        self, vertex: Vertex, wo: mi.Vector3f, emitter: mi.EmitterPtr
    ) -> tuple[list[mi.UInt32], list[mi.UInt32]]:
        """The cells of a path whose last ``vertex`` was connected to a light, in the direction
        ``wo``: if it scatters with a diffuse lobe there, and with a glossy one."""
        light = _looked_up(self._light_class, emitter)
        if not self._tables.reads:
            cells = self._tables.ended(vertex.path.events, light)
            return cells, cells
        return self._tables.lit(vertex.path.events, self._column(vertex, wo), light)

    # ---- Along a light path ----

    def begin_light(self, emitter: mi.EmitterPtr) -> list[mi.UInt32]:
        """The state of the backward automaton behind a light."""
        state = dr.gather(mi.UInt32, self._tables.begins, _looked_up(self._light_class, emitter))
        return [mi.UInt32(state) for _ in range(self.colours)]

    def left_by_light(
        self, vertex: Vertex, bs: mi.BSDFSample3f, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state of a light path behind ``vertex``, in the direction ``bs`` that was sampled
        there."""
        if not self._tables.reads_back:
            return vertex.path.events
        reverse = _reversed(vertex, bs.wo)
        return self._sampled(self._tables.back, reverse, bs, vertex.si.wi, None, active)

    def past(
        self, vertex: Any, to_camera: mi.Vector3f, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state of a light path behind its last ``vertex``, in the direction in which it is
        connected. ``vertex`` is a stored one."""
        if not self._tables.reads_back:
            return vertex.events
        at = Vertex(vertex.si, vertex.si.bsdf(), PathState(*[None] * 6, events=vertex.events))
        if vertex.medium is not None:
            in_medium = vertex.si.shape == None  # noqa: E711
            at.medium = MediumVertex(in_medium, dr.zeros(mi.MediumInteraction3f))
        reverse, wo = _reversed(at, to_camera), vertex.si.wi
        tables = self._tables
        words = tables.words(tables.back, vertex.events, self._column(reverse, wo))
        return states_in(words, self._chosen(reverse, wo, None, active & depends_on_lobe(words)))

    # ---- Where a camera path meets a light path ----

    def at_joint(
        self, vertex: Vertex, wo: mi.Vector3f, others: list[mi.UInt32]
    ) -> tuple[list[mi.UInt32], list[mi.UInt32]]:
        """As :meth:`at_connection`, for a path that is joined with light paths in the states
        ``others``."""
        tables = self._tables
        if not tables.reads:
            cells = tables.met(vertex.path.events, others)
            return cells, cells
        words = tables.words(tables.steps, vertex.path.events, self._column(vertex, wo))
        kinds = ([mi.UInt32(kind)] for kind in (DIFFUSE, GLOSSY))
        diffuse, glossy = (tables.met(states_in(words, kind), others) for kind in kinds)
        return diffuse, glossy

    def in_medium(self, path: PathState, others: list[mi.UInt32]) -> list[mi.UInt32]:
        """The cells of a path that is joined with light paths at a point of a medium, on the way
        to its next vertex."""
        states, tables = path.events, self._tables
        if tables.reads:
            words = tables.words(tables.steps, states, mi.UInt32(SCATTERS))
            states = states_in(words, [mi.UInt32(DIFFUSE)])
        return tables.met(states, others)

    def at_camera(self, others: list[mi.UInt32]) -> list[mi.UInt32]:
        """The cells of light paths that reach the sensor in the states ``others``."""
        return self._tables.met([mi.UInt32(0)] * len(others), others)

    # ---- Along a chain of casters ----

    def event(
        self, shape: mi.ShapePtr, transmits: mi.Bool, is_rough: mi.Bool | bool
    ) -> mi.UInt32:
        """The event at a surface of a chain, which scatters light with a specular lobe, or with a
        glossy one."""
        kind = dr.select(is_rough, mi.UInt32(GLOSSY), SPECULAR)
        return self._of_surface(shape, transmits) * KINDS + kind

    def at_end(
        self,
        vertex: Vertex,
        wo: mi.Vector3f,
        bsdf_value: mi.Spectrum,
        chain: Sequence[tuple[mi.UInt32, mi.Bool]],
        emitter: mi.EmitterPtr,
        active: mi.Bool,
    ) -> list[mi.UInt32]:
        """The cells of a path that leaves ``vertex`` in the direction ``wo``, where the BSDF has
        the value ``bsdf_value``, and is bent by casters until it ends in ``emitter``.

        Args:
            chain: The event at each surface, and whether there is one.
        """
        states, tables = vertex.path.events, self._tables
        if tables.reads:
            words = tables.words(tables.steps, states, self._column(vertex, wo))
            divides = active & depends_on_lobe(words)
            states = states_in(words, self._chosen(vertex, wo, bsdf_value, divides))
            for event, exists in chain:
                words = tables.words(tables.steps, states, event // KINDS)
                behind = states_in(words, [event % KINDS])
                states = [dr.select(exists, new, old) for new, old in zip(behind, states)]
        return tables.ended(states, _looked_up(self._light_class, emitter))

    # ---- Lobes ----

    def lobes(self) -> DiffuseLobes | None:
        """The values of diffuse lobes that a vertex wants to know, which are not known yet."""
        is_wanted = self._mixes and self._undivided is None and not self._disperses
        return DiffuseLobes() if is_wanted else None

    def share(
        self, vertex: Vertex, wo: mi.Vector3f, whole: mi.Spectrum | None, active: mi.Bool,
        known: mi.Spectrum | None = None,
    ) -> mi.UnpolarizedSpectrum | mi.Float:  # fmt: skip
        """The share of diffuse lobes in the value ``whole`` of the BSDF, for each colour. ``known``
        is the value of these lobes, if it is known."""
        if not self._mixes:
            return dr.select(self._kind(vertex.bsdf) == DIFFUSE, mi.Float(1), 0)
        # Where light disperses, values are of the hero alone
        whole = None if self._disperses else whole
        weight = self._weight(vertex)
        return diffuse_share(vertex.bsdf, self._ctx, vertex.si, wo, whole, weight, active, known)

    def _chosen(
        self, vertex: Vertex, wo: mi.Vector3f, whole: mi.Spectrum | None, active: mi.Bool,
        known: mi.Spectrum | None = None,
    ) -> list[mi.UInt32]:  # fmt: skip
        """The kind of lobe that each colour of a path takes for a sampled direction."""
        if not self._mixes:
            return [self._kind(vertex.bsdf)]
        number = _hashed(vertex.si.p, wo)
        return [
            dr.select(number < part, mi.UInt32(DIFFUSE), GLOSSY)
            for part in self.share(vertex, wo, whole, active, known)
        ]

    def _kind(self, bsdf: mi.BSDFPtr) -> mi.UInt32:
        """The kind of the smooth lobes of BSDFs that have only one."""
        if not self._sees_lobes:
            return mi.UInt32(DIFFUSE)
        is_glossy = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
        return dr.select(is_glossy, mi.UInt32(GLOSSY), DIFFUSE)

    def _weight(self, vertex: Vertex) -> mi.Float | None:
        if self._undivided is None:
            return None
        index = dr.reinterpret_array(mi.UInt32, vertex.bsdf)
        known = index < dr.width(self._undivided)
        return dr.select(known, dr.gather(mi.Float, self._undivided, index, known), -1)

    # ---- States ----

    def _sampled(
        self,
        table: mi.UInt32,
        vertex: Vertex,
        bs: mi.BSDFSample3f,
        wo: mi.Vector3f,
        whole: mi.Spectrum | None,
        active: mi.Bool,
        known: mi.Spectrum | None = None,
    ) -> list[mi.UInt32]:
        """The states behind a vertex, for the lobe that ``bs`` is from."""
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        is_straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        column = dr.select(is_straight, mi.UInt32(PASSES), self._column(vertex, wo))
        words = self._tables.words(table, vertex.path.events, column)
        divides = active & ~is_delta & depends_on_lobe(words)
        kinds = self._chosen(vertex, wo, whole, divides, known)
        return states_in(words, [dr.select(is_delta, mi.UInt32(SPECULAR), k) for k in kinds])

    def _column(self, vertex: Vertex, wo: mi.Vector3f) -> mi.UInt32:
        """What happens at a vertex that scatters light between ``si.wi`` and ``wo``."""
        si = vertex.si
        transmits = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) < 0
        column = self._of_surface(si.shape, transmits)
        if vertex.medium is not None:
            column = dr.select(vertex.medium.scatters, mi.UInt32(SCATTERS), column)
        return column

    def _of_surface(self, shape: mi.ShapePtr, transmits: mi.Bool) -> mi.UInt32:
        column = dr.select(transmits, mi.UInt32(TRANSMITS), 0)
        return column + COLUMNS * _looked_up(self._surface_class, shape)


def _reversed(vertex: Vertex, to_camera: mi.Vector3f) -> Vertex:
    """A vertex of a light path, as a camera path sees it that arrives from ``to_camera``."""
    si = mi.SurfaceInteraction3f(vertex.si)
    si.wi = to_camera
    return Vertex(si, vertex.bsdf, vertex.path, None, vertex.medium)


def _looked_up(table: mi.UInt32 | None, pointer: Any) -> mi.UInt32:
    """The entry of a table over Dr.Jit's indices of objects; 0 for objects that it does not
    have, and without a table."""
    if table is None:
        return mi.UInt32(0)
    index = dr.reinterpret_array(mi.UInt32, pointer)
    return dr.gather(mi.UInt32, table, index, index < dr.width(table))


def _hashed(p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
    """A number in [0, 1) that looks random, and is a function of a position and a direction."""
    word = mi.UInt32(0)
    for index, number in enumerate((*p, *d)):
        bits = dr.reinterpret_array(mi.UInt32, number)
        word += bits * ((0x9E3779B1 * (2 * index + 1)) & 0xFFFFFFFF)
    word = (word ^ (word >> 15)) * 0x2C1B3C6D
    word = (word ^ (word >> 13)) * 0x85EBCA6B
    # 23 bits, so that the number stays below 1
    return mi.Float((word ^ (word >> 16)) >> 9) * 2.0**-23
