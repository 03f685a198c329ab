"""Vertices of light paths: how the light walk stores them, and how they are read back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .light_program import StoredHistory
from .stored_interaction import SHAPE_WORD, as_float, from_words, interaction_words, to_words

#: A bit of the word that holds depth and region. It is set where only the hero wavelength of the
#: path is left.
_HERO_IS_ALONE = 1 << 31

#: The path of places behind the last vertex.
_NOBODY = 0xFFFFFFFF

#: Words that Dr.Jit reads and writes at once. A vertex takes a multiple of this number of words.
_PACKET = 8

#: Bits of that word that hold the depth, in layouts that store the region behind it.
_DEPTH_BITS = 15


@dataclass
class Layout:
    """The words of a stored vertex: 19 to 38 in RGB variants.

    Attributes:
        spectrum: Words of a spectrum.
        history: How the history of the path is stored.
        is_whole: Whether all fields of the interaction are stored.
        events: Words of the state of light path expressions.
        has_medium: Whether the medium in which the vertex lies is stored.
    """

    spectrum: int
    history: StoredHistory
    is_whole: bool
    events: int = 0
    has_medium: bool = False

    @property
    def words(self) -> int:
        return -(-(self.state + self.events + self.has_medium) // _PACKET) * _PACKET

    @property
    def state(self) -> int:
        """Index of the first word of the state of expressions: it follows the interaction."""
        return self.mark + 1 + interaction_words(self.is_whole)

    @property
    def mark(self) -> int:
        """Index of the word that holds depth and region: it follows spectrum and history."""
        return self.spectrum + self.history.word_count


class VertexStore:
    """The memory that a light walk writes its vertices to: ``stride`` consecutive places for each
    path.

    Parameters:
        layout: The words of a vertex.
        lanes: Number of paths.
        stride: Largest number of vertices of a path.

    Attributes:
        totals: The number of vertices that were written, and the number of paths that go on. They
            are the only numbers of a round that the host reads.
    """

    def __init__(self, layout: Layout, lanes: int, stride: int) -> None:
        self.layout, self.lanes = layout, lanes
        # Opaque: kernels are the same for paths of all lengths
        self._stride = dr.opaque(mi.UInt32, stride)
        self.words = dr.empty(mi.Float, lanes * stride * layout.words)
        self.totals = dr.zeros(mi.UInt32, 2)

    def places(self) -> tuple[mi.UInt32, mi.UInt32]:
        """The first place of each path, and the place behind its last one."""
        first = dr.arange(mi.UInt32, self.lanes) * self._stride
        return first, first + self._stride

    def write(
        self,
        place: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        β: mi.Spectrum,
        history: Any,
        depth: mi.UInt32,
        hero_is_alone: mi.Bool | None,
        active: mi.Bool,
        events: list[mi.UInt32] | None = None,
        inside: Any = None,
    ) -> None:
        """Writes a vertex. ``inside`` is the state of the path in participating media."""
        mark = mi.UInt32(depth)
        if hero_is_alone is not None:
            mark |= dr.select(hero_is_alone, mi.UInt32(_HERO_IS_ALONE), 0)
        stored = self.layout.history
        if stored.has_region:
            mark |= history.region << _DEPTH_BITS
        words = [*β, *stored.words(history), as_float(mark)]
        words += to_words(si, self.layout.is_whole)
        words += [as_float(state) for state in events or ()]
        if self.layout.has_medium:
            words.append(as_float(inside.medium))
        words += [mi.Float(0)] * (self.layout.words - len(words))
        dr.scatter(self.words, mi.ArrayXf(words), place, active)

    def finish(self, place: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """Counts what was written.

        Parameters:
            place: The place behind the last vertex of each path.
            active: Paths that have not ended.

        Returns:
            The number of vertices of each path.
        """
        number = place - self.places()[0]
        for index, count in enumerate((number, dr.select(active, mi.UInt32(1), 0))):
            dr.scatter_add(self.totals, count, mi.UInt32(index), True, dr.ReduceMode.Local)
        return number


def bytes_per_vertex(layout: Layout) -> int:
    """Bytes of a place in the store."""
    return 4 * layout.words


@dataclass
class LightVertex:
    """A stored vertex, in each lane.

    Attributes:
        si: The interaction there. ``wi`` points towards the previous vertex of the light path.
        β: Radiance · throughput / density of the path up to the vertex.
        history: What the :class:`LightProgram` knows about the path up to the vertex.
        depth: Segments between the light and the vertex; at least 1.
        hero_is_alone: Whether only the first wavelength is left; ``None`` where nothing disperses
            light.
        lane: The number of the light path.
        events: The state of light path expressions at the vertex; ``None`` without any.
        medium: The participating medium in which the light has arrived; ``None`` if it is not
            stored.
    """

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum
    history: Any
    depth: mi.UInt32
    hero_is_alone: mi.Bool | None
    lane: mi.UInt32
    events: list[mi.UInt32] | None = None
    medium: mi.MediumPtr | None = None


class VertexCache:
    """The vertices that light paths have stored, as a list without gaps, in the order of the paths
    and along each path. All of them can be connected: their BSDFs have a smooth part, or they lie
    in participating media.

    Parameters:
        layout: The words of a vertex.
        count: Number of vertices.
        number: The number of vertices of each path.
        time, wavelengths: Time and wavelengths of each path.
        disperses: Whether vertices may have only the hero wavelength left.

    Attributes:
        paths (int): Number of paths.
        number, end (mi.UInt32): The number of vertices of each path, and the index behind its last
            vertex.
        count (int): Number of vertices.
        room (int): The number of lanes or places that these vertices have (:func:`room_for`).
    """

    def __init__(
        self,
        layout: Layout,
        count: int,
        number: mi.UInt32,
        time: mi.Float,
        wavelengths: mi.Spectrum,
        disperses: bool,
    ) -> None:
        self._layout, self.number, self._disperses = layout, number, disperses
        self._time, self._wavelengths = time, wavelengths
        self.paths, self.count, self.room = len(number), count, room_for(count)
        self.end = dr.cumsum(number)
        self._words = dr.empty(mi.Float, self.room * layout.words)
        self._lane = dr.full(mi.UInt32, _NOBODY, self.room)

    @classmethod
    def packed(
        cls,
        store: VertexStore,
        count: int,
        number: mi.UInt32,
        time: mi.Float,
        wavelengths: mi.Spectrum,
        disperses: bool,
    ) -> VertexCache:
        """The vertices of a store, without its gaps. The memory of the store is given back."""
        cache = cls(store.layout, count, number, time, wavelengths, disperses)
        cache._copy(store.words, store.places()[0], number, cache.end - number)
        dr.eval(cache._words, cache._lane)
        store.words = mi.Float()
        return cache

    @classmethod
    def joined(cls, rounds: list[VertexCache]) -> VertexCache:
        """The vertices of some rounds of a light walk. The memory of the rounds is given back."""
        if len(rounds) == 1:
            return rounds[0]
        last, number = rounds[-1], sum((one.number for one in rounds[1:]), rounds[0].number)
        dr.eval(number)
        count = sum(one.count for one in rounds)
        cache = cls(last._layout, count, number, last._time, last._wavelengths, last._disperses)
        place = cache.end - number
        for one in rounds:
            after = place + one.number
            cache._copy(one._words, one.end - one.number, one.number, place)
            dr.eval(cache._words, cache._lane, after)
            one._words, place = mi.Float(), after
        return cache

    @dr.syntax
    def _copy(self, words, source, number, target) -> None:
        """Copies ``number`` vertices of each path from places ``source`` of other memory to
        ``target``."""
        lane, index = dr.arange(mi.UInt32, self.paths), dr.zeros(mi.UInt32, self.paths)
        while dr.hint(index < number, label="vertices of a path"):
            packet = dr.gather(
                mi.ArrayXf, words, source + index, shape=(self._layout.words, self.paths)
            )
            dr.scatter(self._words, packet, target + index)
            dr.scatter(self._lane, lane, target + index)
            index += 1

    def kernel_state(self) -> tuple:
        """The arrays and constants that kernels depend on."""
        return (
            self._layout, self._words, self._time, self._wavelengths, self._disperses, self._lane,
            self.end, self.number,
        )  # fmt: skip

    def every(self) -> tuple[mi.UInt32, mi.Bool]:
        """For ``room`` lanes: the index of a vertex, and whether the lane has a vertex."""
        # A kernel reads the paths of vertices directly, and thus has their width in any recording
        return dr.arange(mi.UInt32, dr.width(self._lane)), self._lane != _NOBODY

    def at(self, index: mi.UInt32, active: mi.Bool) -> LightVertex:
        """The vertices with these indices."""
        layout, n = self._layout, self._layout.spectrum
        w = dr.gather(
            mi.ArrayXf, self._words, index, active, shape=(layout.words, dr.width(index))
        )
        mark = dr.reinterpret_array(mi.UInt32, w[layout.mark])
        depth, region = mark & (_HERO_IS_ALONE - 1), None
        if layout.history.has_region:
            depth, region = _depth_and_region(mark)
        history = layout.history.read([w[i] for i in range(n, layout.mark)], depth, region)
        lane = dr.gather(mi.UInt32, self._lane, index, active)
        si = from_words([w[i] for i in range(layout.mark + 1, layout.state)], layout.is_whole)
        si.t = dr.select(active, mi.Float(0), dr.inf)
        si.time = self._of_lane(self._time, lane, active)
        if mi.is_spectral:
            si.wavelengths = self._of_lane(self._wavelengths, lane, active)
        hero_is_alone = (mark & _HERO_IS_ALONE) != 0 if self._disperses else None
        β = mi.Spectrum(*(w[i] for i in range(n)))
        states = range(layout.state, layout.state + layout.events)
        events = [dr.reinterpret_array(mi.UInt32, w[i]) for i in states] or None
        medium = None
        if layout.has_medium:
            medium = dr.reinterpret_array(
                mi.MediumPtr, dr.reinterpret_array(mi.UInt32, w[states.stop])
            )
            # A point without a normal has no words for it
            si.n = dr.select(si.shape == None, 0, si.n)  # noqa: E711
        return LightVertex(si, β, history, depth, hero_is_alone, lane, events, medium)

    def position(self, index: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        """The positions of the vertices with these indices."""
        word = index * self._layout.words + (self._layout.mark + 1)
        return mi.Point3f(*(dr.gather(mi.Float, self._words, word + k, active) for k in range(3)))

    def depth(self, index: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The depths of the vertices with these indices."""
        word = index * self._layout.words + self._layout.mark
        mark = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._words, word, active))
        if self._layout.history.has_region:
            return _depth_and_region(mark)[0]
        return mark & (_HERO_IS_ALONE - 1)

    def is_caustic(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether light arrives from a delta lobe at the vertices with these indices."""
        word = index * self._layout.words + self._layout.spectrum
        first = dr.gather(mi.Float, self._words, word, active)
        return (self.depth(index, active) > 1) & (first == 0)

    def is_in_medium(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether the vertices with these indices lie in participating media."""
        word = index * self._layout.words + (self._layout.mark + 1 + SHAPE_WORD)
        shape = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._words, word, active))
        return active & (shape == 0)

    def is_on_surface(self, index: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether the vertices with these indices lie on surfaces."""
        return active & ~self.is_in_medium(index, active)

    def group(self, index: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """:func:`group_of` time and wavelengths of the vertices with these indices."""
        lane = dr.gather(mi.UInt32, self._lane, index, active)
        time = self._of_lane(self._time, lane, active)
        return group_of(time, self._of_lane(self._wavelengths, lane, active))

    def wavelengths(self, vertex: LightVertex, active: mi.Bool) -> mi.Spectrum | None:
        """The wavelengths of a vertex's path; ``None`` in variants that are not spectral."""
        return self._of_lane(self._wavelengths, vertex.lane, active) if mi.is_spectral else None

    def _of_lane(self, values: Any, lane: mi.UInt32, active: mi.Bool) -> Any:
        return values if dr.width(values) == 1 else dr.gather(type(values), values, lane, active)

    @property
    def region(self) -> mi.UInt32:
        """The region in which each vertex lies. Only for histories with ``has_region``."""
        layout = self._layout
        index = dr.arange(mi.UInt32, self.count) * layout.words + layout.mark
        mark = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._words, index))
        return _depth_and_region(mark)[1]


def group_of(time: mi.Float, wavelengths: mi.Spectrum) -> mi.UInt32:
    """A number that is the same for all paths with the same time and wavelengths."""
    word = dr.reinterpret_array(mi.UInt32, mi.Float(time)) * 0x27D4EB2F
    if mi.is_spectral:
        word ^= dr.reinterpret_array(mi.UInt32, wavelengths[0]) * 0x165667B1
    return word ^ (word >> 16)


def room_for(count: int) -> int:
    """The number of lanes or places for ``count`` vertices. It is rounded up, so that many passes
    have the same number and share kernels. It is at least 16: very small widths would need kernels
    of their own."""
    step = max(16, 1 << max(0, count.bit_length() - 4))
    return -(-count // step) * step


def _depth_and_region(mark: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Depth and region from the word that holds both, with 16 bits for the region."""
    return mark & ((1 << _DEPTH_BITS) - 1), (mark & (_HERO_IS_ALONE - 1)) >> _DEPTH_BITS
