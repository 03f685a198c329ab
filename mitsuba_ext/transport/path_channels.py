"""Light path expressions in the random walk: each path keeps the state of the automaton that reads
its events, and what it gains is added to the cell that the automaton names
(``scene/expressions``).

**What an event is.** Media scatter with ``V``. At a surface, the two directions give the type:
``R`` if they are on one side of the surface, otherwise ``T``. The lobe gives the scattering. Delta
lobes (``S``, or ``s`` where light goes straight on) are found by sampling only, so that the lobe is
known. Other lobes are found in two ways: by sampling, and by connections, which evaluate all lobes
together. MIS weights are for the sum of the lobes. What is diffuse about a pair of directions must
therefore follow from this pair alone: it is the share of the diffuse lobes in the value of the BSDF
(:func:`.bsdfs.diffuse_share`), for each colour.

- A connection is divided by this share, and added to two cells.
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

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.bsdfs import mixes_lobes, undivided_bsdfs
from ..scene.expressions.alphabet import PER_CLASS, STRAIGHT, VOLUME, Alphabet
from ..scene.expressions.automaton import Automaton
from ..scene.expressions.notation import Expression
from ..util.arrays import add_own, from_numpy
from ..util.spectra import to_rgb
from .bsdfs import diffuse_share
from .estimator import CameraRays
from .heroes import Heroes
from .vertex import MediumVertex, PathState, Vertex

#: The kinds of lobes, in the order of the alphabet's symbols, and their number.
_DIFFUSE, _GLOSSY, _SPECULAR, _KINDS = 0, 1, 2, 3

#: Bytes of the result of a path, which is stored until the channels are read, and of its random
#: numbers.
_RESULT_BYTES = 64


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class PathChannels:
    """Adds the light of camera paths to the channels of expressions. The state of a path is a list:
    one state for all colours, or a state for each of them.

    Parameters:
        scene: The scene.
        expressions: The expressions, one for each channel.

    Raises:
        ValueError: A label of an expression is not in the scene, or the expressions are too
            complex.
    """

    def __init__(self, scene: mi.Scene, expressions: Sequence[Expression]) -> None:
        alphabet = Alphabet.of(scene, expressions)
        automaton = Automaton.of(expressions, alphabet.vertices, alphabet.lights)
        self._names, self._surface_class = alphabet.light_class, alphabet.surface_class
        self._symbols, self._lights = len(alphabet.vertices), len(alphabet.lights)
        self._next = from_numpy(mi.UInt32, automaton.next)
        self._ends = from_numpy(mi.UInt32, automaton.ends)
        self._begins = from_numpy(mi.UInt32, automaton.begins)
        self._back = from_numpy(mi.UInt32, automaton.back)
        self._pairs, self._backs = from_numpy(mi.UInt32, automaton.pairs), len(automaton.back)
        # The cells of each expression; cell 0 is not stored
        cells = list(enumerate(automaton.cells))[1:]
        self._of = [[i - 1 for i, c in cells if k in c] for k in range(len(expressions))]
        self._cells = max(1, len(cells))
        self._accepts = from_numpy(mi.UInt32, _masks(automaton.cells, len(expressions)))
        self._reads = len(automaton.next) > 1
        lobes = [
            (first + side + _DIFFUSE, first + side + _GLOSSY)
            for first in range(0, self._symbols, PER_CLASS) for side in (0, _KINDS)
        ]  # fmt: skip
        self._sees_lobes = any(automaton.tells_apart(*symbols) for symbols in lobes)
        self._mixes = self._sees_lobes and mixes_lobes(scene)
        # The states in which it matters whether the next event is diffuse; `None` if all are
        divides = np.any([automaton.where_apart(*symbols) for symbols in lobes], axis=0)
        self._divides = None if divides.all() else from_numpy(mi.Bool, divides)
        self._undivided = undivided_bsdfs(scene) if self._mixes else None
        heroes = Heroes(scene)
        self._ctx, self._disperses = heroes.context(), heroes.are_needed
        self._lane, self._sums = mi.UInt32(0), _Sums(1)

    @property
    def sample_bytes(self) -> int:
        """The memory of a sample in a pass: its sums, and the result of its path."""
        return self._cells * _Sums.bytes_each() + _RESULT_BYTES

    def kernel_state(self) -> tuple:
        """The attributes that kernels depend on; a pass makes the others."""
        return (
            self._names, self._surface_class, self._symbols, self._lights, self._next, self._ends,
            self._of, self._cells, self._reads, self._sees_lobes, self._mixes, self._undivided,
            self._begins, self._back, self._pairs, self._backs, self._accepts, self._disperses,
            self._divides,
        )  # fmt: skip

    # ---- Along a path ----

    def begin(self, rays: CameraRays) -> list[mi.UInt32]:
        """The state before the first vertex."""
        lanes = dr.width(rays.ray)
        self._lane = dr.arange(mi.UInt32, lanes)
        self._sums = _Sums(lanes * self._cells)
        return [mi.UInt32(0) for _ in range(self.colours)]

    @property
    def colours(self) -> int:
        """The number of states of a path."""
        return len(mi.UnpolarizedSpectrum()) if self._mixes else 1

    def emitted(
        self, path: PathState, emitter: mi.EmitterPtr, value: mi.Spectrum, active: mi.Bool
    ) -> None:
        """The path has hit a light, and gains ``value``."""
        self._add(self._ended(path.events, _looked_up(self._names, emitter)), value, active)

    def connected(
        self,
        vertex: Vertex,
        ds: mi.DirectionSample3f,
        bsdf_value: mi.Spectrum,
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """``vertex`` was connected to a light, towards which the BSDF has the value ``bsdf_value``,
        and the path gains ``value``."""
        wo = vertex.si.to_local(ds.d)
        light = _looked_up(self._names, ds.emitter)
        self._gain(vertex, wo, bsdf_value, value, active, lambda s: self._ended(s, light))

    def left(
        self, vertex: Vertex, bs: mi.BSDFSample3f, weight: mi.Spectrum, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state behind ``vertex``, in the direction ``bs`` that was sampled there. ``weight``
        is the BSDF's value in this direction / density."""
        if not self._reads:
            return vertex.path.events
        if self._divides is not None:
            states = vertex.path.events
            active = active & _any(dr.gather(mi.Bool, self._divides, s, active) for s in states)
        return self._behind(vertex, self._sampled(vertex, bs, bs.wo, weight * bs.pdf, active))

    def _sampled(
        self,
        vertex: Vertex,
        bs: mi.BSDFSample3f,
        wo: mi.Vector3f,
        whole: mi.Spectrum | None,
        active: mi.Bool,
    ) -> list[mi.UInt32]:
        """The symbol that each colour reads at a vertex, for the lobe that ``bs`` is from."""
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        is_straight = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        symbols = []
        for kind in self._chosen(vertex, wo, whole, active & ~is_delta):
            kind = dr.select(is_delta, mi.UInt32(_SPECULAR), kind)
            symbol = self._symbol(vertex, wo, kind)
            symbols.append(dr.select(is_straight, mi.UInt32(STRAIGHT), symbol))
        return symbols

    def values(self, rays: CameraRays) -> list[mi.Float]:
        """The channels of each path: the colours of the first expression, and so on. The kernel of
        the walk must have run."""
        parts = [
            self._sums.at(self._lane * self._cells + cell) for cell in range(self._cells)
        ]
        found = []
        for cells in self._of:
            total = sum((parts[cell] for cell in cells), mi.Spectrum(0))
            found += film_colours(total * rays.importance, rays.ray.wavelengths)
        return found

    # ---- Along a light path ----

    def begin_light(self, emitter: mi.EmitterPtr) -> list[mi.UInt32]:
        """The state of the backward automaton behind a light."""
        state = dr.gather(mi.UInt32, self._begins, _looked_up(self._names, emitter))
        return [mi.UInt32(state) for _ in range(self.colours)]

    def left_by_light(
        self, vertex: Vertex, bs: mi.BSDFSample3f, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state of a light path behind ``vertex``, in the direction ``bs`` that was sampled
        there."""
        if self._backs == 1:
            return vertex.path.events
        symbols = self._sampled(_reversed(vertex, bs.wo), bs, vertex.si.wi, None, active)
        return self._before(vertex, symbols)

    def past(
        self, vertex: Any, to_camera: mi.Vector3f, active: mi.Bool
    ) -> list[mi.UInt32]:
        """The state of a light path behind its last ``vertex``, in the direction in which it is
        connected. ``vertex`` is a stored one."""
        path = PathState(*[None] * 6, events=vertex.events)
        at = Vertex(vertex.si, vertex.si.bsdf(), path)
        if vertex.medium is not None:
            in_medium = vertex.si.shape == None  # noqa: E711
            at.medium = MediumVertex(in_medium, dr.zeros(mi.MediumInteraction3f))
        if self._backs == 1:
            return vertex.events
        reverse, wo = _reversed(at, to_camera), vertex.si.wi
        kinds = self._chosen(reverse, wo, None, active)
        return self._before(at, [self._symbol(reverse, wo, kind) for kind in kinds])

    def joined(
        self,
        vertex: Vertex,
        wo: mi.Vector3f,
        bsdf_value: mi.Spectrum,
        others: list[mi.UInt32],
        value: mi.Spectrum,
        active: mi.Bool,
    ) -> None:
        """The path gains ``value`` from light paths with the states ``others``, whose light arrives
        at ``vertex`` from the local direction ``wo``. The BSDF has the value ``bsdf_value``
        there."""
        self._gain(vertex, wo, bsdf_value, value, active, lambda s: self._met(s, others))

    def joined_in_medium(
        self, path: PathState, others: list[mi.UInt32], value: mi.Spectrum, active: mi.Bool
    ) -> None:
        """As :meth:`joined`, at a point of a medium on the way to the next vertex of ``path``."""
        states = path.events
        if self._reads:
            states = [
                dr.gather(mi.UInt32, self._next, state * self._symbols + VOLUME)
                for state in states
            ]
        self._add(self._met(states, others), value, active)

    def splatted(self, others: list[mi.UInt32], value: mi.Spectrum) -> list[mi.Spectrum]:
        """The part of ``value`` that each channel gains where light paths with the states
        ``others`` reach the sensor."""
        cells = self._met([mi.UInt32(0)] * len(others), others)
        found = []
        for index in range(len(self._of)):
            word = -(-len(self._of) // 32)
            parts = [
                (dr.gather(mi.UInt32, self._accepts, c * word + index // 32) >> index % 32) & 1
                for c in cells
            ]
            parts = parts * len(value) if len(parts) < len(value) else parts
            found.append(mi.Spectrum(*(dr.select(p == 1, v, 0) for p, v in zip(parts, value))))
        return found

    # ---- Along a chain of smooth surfaces ----

    def specular(self, shape: mi.ShapePtr, transmits: mi.Bool) -> mi.UInt32:
        """The symbol of a smooth surface in a chain."""
        return self._of_surface(shape, mi.UInt32(_SPECULAR), transmits)

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
        the value ``bsdf_value``, and is bent by smooth surfaces until it ends in ``emitter``: see
        :meth:`add`.

        Args:
            chain: The symbol of each surface, and whether there is one.
        """
        kinds = self._chosen(vertex, wo, bsdf_value, active)
        states = self._behind(vertex, [self._symbol(vertex, wo, kind) for kind in kinds])
        for symbol, exists in chain if self._reads else ():
            states = [
                dr.select(exists, dr.gather(mi.UInt32, self._next, s * self._symbols + symbol), s)
                for s in states
            ]
        light = _looked_up(self._names, emitter)
        return [dr.gather(mi.UInt32, self._ends, s * self._lights + light) for s in states]

    def add(self, cells: list[mi.UInt32], value: mi.Spectrum) -> None:
        """Adds the light of a path to its cells."""
        self._add(cells, value, mi.Bool(True))

    # ---- Symbols ----

    def _gain(
        self,
        vertex: Vertex,
        wo: mi.Vector3f,
        whole: mi.Spectrum,
        value: mi.Spectrum,
        active: mi.Bool,
        cells_of: Callable[[list[mi.UInt32]], list[mi.UInt32]],
    ) -> None:
        """Divides the ``value`` of a connection among the kinds of lobes, whose sum is ``whole``.
        ``cells_of`` finds the cells of the states behind the vertex."""
        if not self._mixes:
            symbol = self._symbol(vertex, wo, self._kind(vertex.bsdf))
            self._add(cells_of(self._behind(vertex, [symbol])), value, active)
            return
        diffuse, glossy = (
            cells_of(self._behind(vertex, [self._symbol(vertex, wo, mi.UInt32(kind))]))
            for kind in (_DIFFUSE, _GLOSSY)
        )
        # Where both belong to the same channels, no lobe is evaluated
        divides = active & _any(one != other for one, other in zip(diffuse, glossy))
        share = self._diffuse_share(vertex, wo, whole, divides)
        share = dr.select(divides, share, 1)
        self._add(diffuse, value * share, active)
        self._add(glossy, value * (1 - share), divides)

    def _chosen(
        self, vertex: Vertex, wo: mi.Vector3f, whole: mi.Spectrum | None, active
    ) -> list[mi.UInt32]:
        """The kind of lobe that each colour of a path takes for a sampled direction."""
        if not self._mixes:
            return [self._kind(vertex.bsdf)]
        share = self._diffuse_share(vertex, wo, whole, active)
        number = _hashed(vertex.si.p, wo)
        return [dr.select(number < part, mi.UInt32(_DIFFUSE), _GLOSSY) for part in share]

    def _diffuse_share(self, vertex: Vertex, wo: mi.Vector3f, whole, active):
        # Where light disperses, values are of the hero alone
        whole = None if self._disperses else whole
        weight = self._weight(vertex)
        return diffuse_share(vertex.bsdf, self._ctx, vertex.si, wo, whole, weight, active)

    def _kind(self, bsdf: mi.BSDFPtr) -> mi.UInt32:
        """The kind of the smooth lobes of BSDFs that have only one."""
        if not self._sees_lobes:
            return mi.UInt32(_DIFFUSE)
        is_glossy = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
        return dr.select(is_glossy, mi.UInt32(_GLOSSY), _DIFFUSE)

    def _weight(self, vertex: Vertex) -> mi.Float | None:
        if self._undivided is None:
            return None
        index = dr.reinterpret_array(mi.UInt32, vertex.bsdf)
        known = index < dr.width(self._undivided)
        return dr.select(known, dr.gather(mi.Float, self._undivided, index, known), -1)

    def _symbol(self, vertex: Vertex, wo: mi.Vector3f, kind: mi.UInt32) -> mi.UInt32:
        """The symbol of a vertex that scatters light between ``si.wi`` and ``wo``."""
        si = vertex.si
        transmits = mi.Frame3f.cos_theta(si.wi) * mi.Frame3f.cos_theta(wo) < 0
        symbol = self._of_surface(si.shape, kind, transmits)
        if vertex.medium is not None:
            symbol = dr.select(vertex.medium.scatters, mi.UInt32(VOLUME), symbol)
        return symbol

    def _of_surface(
        self, shape: mi.ShapePtr, kind: mi.UInt32, transmits: mi.Bool
    ) -> mi.UInt32:
        symbol = kind + dr.select(transmits, mi.UInt32(_KINDS), 0)
        if self._surface_class is not None:
            symbol += PER_CLASS * _looked_up(self._surface_class, shape)
        return symbol

    # ---- States ----

    def _behind(self, vertex: Vertex, symbols: list[mi.UInt32]) -> list[mi.UInt32]:
        """The states behind a vertex. All colours can share a symbol."""
        states = vertex.path.events
        if not self._reads:
            return states
        if len(symbols) < len(states):
            symbols = symbols * len(states)
        return [
            dr.gather(mi.UInt32, self._next, state * self._symbols + symbol)
            for state, symbol in zip(states, symbols)
        ]

    def _before(self, vertex: Vertex, symbols: list[mi.UInt32]) -> list[mi.UInt32]:
        """The states of the backward automaton behind a vertex of a light path."""
        states = vertex.path.events
        if len(symbols) < len(states):
            symbols = symbols * len(states)
        return [
            dr.gather(mi.UInt32, self._back, state * self._symbols + symbol)
            for state, symbol in zip(states, symbols)
        ]

    def _met(self, states: list[mi.UInt32], others: list[mi.UInt32]) -> list[mi.UInt32]:
        """The cells of paths that are joined from two subpaths."""
        return [
            dr.gather(mi.UInt32, self._pairs, state * self._backs + other)
            for state, other in zip(states, others)
        ]

    def _ended(self, states: list[mi.UInt32], light: mi.UInt32) -> list[mi.UInt32]:
        """The cells of paths that end at a light."""
        return [dr.gather(mi.UInt32, self._ends, s * self._lights + light) for s in states]

    def _add(self, cells: list[mi.UInt32], value: mi.Spectrum, active) -> None:
        """Adds a value to cells: to one, or each colour to its own."""
        active = active & (dr.max(dr.abs(value)) > 0)
        for index, cell in enumerate(cells):
            # Colours mostly share a cell, and are added at once
            shares = [other == cell for other in cells]
            is_first = active & (cell > 0)
            for earlier in cells[:index]:
                is_first &= earlier != cell
            words = [dr.select(share, part, 0) for share, part in zip(shares, value)]
            if len(cells) == 1:
                words = list(value)
            self._sums.add(self._lane * self._cells + cell - 1, words, is_first)


class _Sums:
    """Sums of spectra, each of which belongs to one lane. They lie in packets of four numbers,
    which Dr.Jit reads and writes at once, in a quarter of the time.

    Parameters:
        count: The number of sums.
    """

    def __init__(self, count: int) -> None:
        self._packet = self.bytes_each() // 4
        self._words = dr.zeros(mi.Float, count * self._packet)

    @staticmethod
    def bytes_each() -> int:
        """The memory of a sum."""
        return 4 if len(mi.Spectrum()) == 1 else 16

    @dr.syntax
    def add(self, index: mi.UInt32, words: list[mi.Float], active: mi.Bool) -> None:
        """Adds a spectrum. Where no lane of a vector unit does, nothing is read or written."""
        if active:
            self._add(index, words, active)

    def _add(self, index: mi.UInt32, words: list[mi.Float], active: mi.Bool) -> None:
        if self._packet == 1:
            add_own(self._words, words[0], index, active)
            return
        words = words + [mi.Float(0)] * (self._packet - len(words))
        add_own(self._words, mi.Vector4f(*words), index, active)

    def at(self, index: mi.UInt32) -> mi.Spectrum:
        """The sums with these indices."""
        if self._packet == 1:
            return mi.Spectrum(dr.gather(mi.Float, self._words, index))
        words = dr.gather(mi.Vector4f, self._words, index)
        return mi.Spectrum(*(words[k] for k in range(len(mi.Spectrum()))))


def colour_names() -> str:
    """The letters of the colours that an expression has in the film."""
    return "Y" if mi.is_monochromatic else "RGB"


def film_colours(value: mi.Spectrum, wavelengths: mi.Spectrum | None) -> list[mi.Float]:
    """The values of these colours."""
    return list(to_rgb(value, wavelengths))[: len(colour_names())]


def _any(masks: Iterable[mi.Bool]) -> mi.Bool:
    return functools.reduce(operator.or_, masks)


def _reversed(vertex: Vertex, to_camera: mi.Vector3f) -> Vertex:
    """A vertex of a light path, as a camera path sees it that arrives from ``to_camera``."""
    si = mi.SurfaceInteraction3f(vertex.si)
    si.wi = to_camera
    return Vertex(si, vertex.bsdf, vertex.path, None, vertex.medium)


def _masks(cells: Sequence[frozenset[int]], count: int) -> np.ndarray:
    """A bit for each of ``count`` expressions: whether it has a cell. A word has 32 bits."""
    masks = np.zeros((len(cells), -(-count // 32)), np.uint32)
    for row, cell in zip(masks, cells):
        for index in cell:
            row[index // 32] |= np.uint32(1 << index % 32)
    return masks


def _looked_up(table: mi.UInt32, pointer: Any) -> mi.UInt32:
    """The entry of a table over Dr.Jit's indices of objects; 0 for objects that it does not
    have."""
    index = dr.reinterpret_array(mi.UInt32, pointer)
    return dr.gather(mi.UInt32, table, index, index < dr.width(table))


def _hashed(p: mi.Point3f, d: mi.Vector3f) -> mi.Float:
    """A number in [0, 1) that looks random, and is a function of a position and a direction."""
    word = mi.UInt32(0)
    for number in (*p, *d):
        word = (word ^ dr.reinterpret_array(mi.UInt32, number)) * 0x9E3779B1
        word ^= word >> 15
    word = (word ^ (word >> 13)) * 0x85EBCA6B
    # 23 bits, so that the number stays below 1
    return mi.Float((word ^ (word >> 16)) >> 9) * 2.0**-23
