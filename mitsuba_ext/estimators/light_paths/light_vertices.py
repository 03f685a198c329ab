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
    """

    spectrum: int
    history: StoredHistory
    is_whole: bool

    @property
    def words(self) -> int:
        used = self.mark + 1 + interaction_words(self.is_whole)
        return -(-used // _PACKET) * _PACKET

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
    """

    def __init__(self, layout: Layout, lanes: int, stride: int) -> None:
        self.layout, self.stride, self.lanes = layout, stride, lanes
        self.words = dr.empty(mi.Float, lanes * stride * layout.words)
        self.is_taken = dr.zeros(mi.Bool, lanes * stride)

    @property
    def bytes(self) -> int:
        """Memory of the store, in bytes."""
        return self.lanes * self.stride * bytes_per_vertex(self.layout)

    def write(
        self,
        slot: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        β: mi.Spectrum,
        history: Any,
        depth: mi.UInt32,
        hero_is_alone: mi.Bool | None,
        active: mi.Bool,
    ) -> None:
        """Writes a vertex."""
        mark = mi.UInt32(depth)
        if hero_is_alone is not None:
            mark |= dr.select(hero_is_alone, mi.UInt32(_HERO_IS_ALONE), 0)
        stored = self.layout.history
        if stored.has_region:
            mark |= history.region << _DEPTH_BITS
        words = [*β, *stored.words(history), as_float(mark)]
        words += to_words(si, self.layout.is_whole)
        words += [mi.Float(0)] * (self.layout.words - len(words))
        dr.scatter(self.words, mi.ArrayXf(words), slot, active)
        dr.scatter(self.is_taken, mi.Bool(True), slot, active)


def bytes_per_vertex(layout: Layout) -> int:
    """Bytes of a place in the store: the words, and a flag."""
    return 4 * layout.words + 1


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
    """

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum
    history: Any
    depth: mi.UInt32
    hero_is_alone: mi.Bool | None
    lane: mi.UInt32


class LightVertices:
    """The vertices that a pass has stored, as a list without gaps, in the order of the paths and
    along each path. All of them can be connected: their BSDFs have a smooth part, or they lie in
    participating media.

    Parameters:
        store: The store that the light walk has written.
        time, wavelengths: Time and wavelengths of each path.
        disperses: Whether vertices may have only the hero wavelength left.

    Attributes:
        count (int): Number of vertices.
        slot (mi.UInt32): The place of each in the store: path · stride + index along the path.
        stride (int): Places of each path.
        bytes (int): Memory that the vertices take.
    """

    def __init__(
        self, store: VertexStore, time: mi.Float, wavelengths: mi.Spectrum, disperses: bool
    ) -> None:
        self._layout, self._words = store.layout, store.words
        self._time, self._wavelengths, self._disperses = time, wavelengths, disperses
        self.stride, self._lane = store.stride, None
        self.slot = dr.compress(store.is_taken)
        self.count = len(self.slot)
        self.room = room_for(self.count)
        self.bytes = store.bytes + 4 * self.count

    def kernel_state(self) -> tuple:
        """The arrays and constants that kernels depend on."""
        return (
            self._layout, self._words, self._time, self._wavelengths, self._disperses, self._lane,
            self.stride,
        )  # fmt: skip

    def lanes(self) -> tuple[mi.UInt32, mi.Bool]:
        """For ``room`` lanes: the place of a vertex in the store, and whether the lane has a
        vertex."""
        index = dr.arange(mi.UInt32, self.room)
        active = index < dr.opaque(mi.UInt32, self.count)
        slot = dr.gather(mi.UInt32, self.slot, index, active)
        dr.eval(slot, active)
        return slot, active

    def at(self, slot: mi.UInt32, active: mi.Bool) -> LightVertex:
        """The vertices at these places of the store. A vertex must have been written to each."""
        layout, n = self._layout, self._layout.spectrum
        w = dr.gather(
            mi.ArrayXf, self._words, slot, active, shape=(layout.words, dr.width(slot))
        )
        mark = dr.reinterpret_array(mi.UInt32, w[layout.mark])
        depth, region = mark & (_HERO_IS_ALONE - 1), None
        if layout.history.has_region:
            depth, region = _depth_and_region(mark)
        history = layout.history.read([w[i] for i in range(n, layout.mark)], depth, region)
        lane = self._lane_of(slot, active)
        si = from_words([w[i] for i in range(layout.mark + 1, layout.words)], layout.is_whole)
        si.t = dr.select(active, mi.Float(0), dr.inf)
        si.time = self._of_lane(self._time, lane, active)
        if mi.is_spectral:
            si.wavelengths = self._of_lane(self._wavelengths, lane, active)
        hero_is_alone = (mark & _HERO_IS_ALONE) != 0 if self._disperses else None
        β = mi.Spectrum(*(w[i] for i in range(n)))
        return LightVertex(si, β, history, depth, hero_is_alone, lane)

    def position(self, slot: mi.UInt32, active: mi.Bool) -> mi.Point3f:
        """The positions of the vertices at these places of the store."""
        word = slot * self._layout.words + (self._layout.mark + 1)
        return mi.Point3f(*(dr.gather(mi.Float, self._words, word + k, active) for k in range(3)))

    def depth(self, slot: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """The depths of the vertices at these places of the store."""
        word = slot * self._layout.words + self._layout.mark
        mark = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._words, word, active))
        if self._layout.history.has_region:
            return _depth_and_region(mark)[0]
        return mark & (_HERO_IS_ALONE - 1)

    def is_caustic(self, slot: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether light arrives from a delta lobe at the vertices at these places of the store."""
        word = slot * self._layout.words + self._layout.spectrum
        first = dr.gather(mi.Float, self._words, word, active)
        return (self.depth(slot, active) > 1) & (first == 0)

    def is_in_medium(self, slot: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether the vertices at these places of the store lie in participating media."""
        word = slot * self._layout.words + (self._layout.mark + 1 + SHAPE_WORD)
        shape = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, self._words, word, active))
        return active & (shape == 0)

    def is_on_surface(self, slot: mi.UInt32, active: mi.Bool) -> mi.Bool:
        """Whether the vertices at these places of the store lie on surfaces."""
        return active & ~self.is_in_medium(slot, active)

    def group(self, slot: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        """:func:`group_of` time and wavelengths of the vertices at these places of the store."""
        lane = self._lane_of(slot, active)
        time = self._of_lane(self._time, lane, active)
        return group_of(time, self._of_lane(self._wavelengths, lane, active))

    def wavelengths(self, vertex: LightVertex, active: mi.Bool) -> mi.Spectrum | None:
        """The wavelengths of a vertex's path; ``None`` in variants that are not spectral."""
        return self._of_lane(self._wavelengths, vertex.lane, active) if mi.is_spectral else None

    def _lane_of(self, slot: mi.UInt32, active: mi.Bool) -> mi.UInt32:
        if self._lane is None:
            return slot // self.stride
        return dr.gather(mi.UInt32, self._lane, slot, active)

    def _of_lane(self, values: Any, lane: mi.UInt32, active: mi.Bool) -> Any:
        return values if dr.width(values) == 1 else dr.gather(type(values), values, lane, active)


class PackedVertices(LightVertices):
    """Vertices without the gaps of a store, which take most of the memory. The place of a vertex
    is its index.

    Parameters:
        vertices: The vertices to pack. Their memory is given back.
    """

    def __init__(self, vertices: LightVertices) -> None:
        self._share_paths_of(vertices)
        self.count, self.room, words = vertices.count, vertices.room, self._layout.words
        self._lane = vertices._lane_of(vertices.slot, mi.Bool(True))
        packet = dr.gather(
            mi.ArrayXf, vertices._words, vertices.slot, shape=(words, self.count)
        )
        self._words = dr.empty(mi.Float, self.room * words)
        dr.scatter(self._words, packet, dr.arange(mi.UInt32, self.count))
        dr.eval(self._words, self._lane)
        self._lane = _widened(self._lane, self.room)
        vertices._words = vertices._lane = None
        self.bytes = self.count * (4 * words + 4)

    def _share_paths_of(self, vertices: LightVertices) -> None:
        self._layout, self._disperses, self.stride = vertices._layout, vertices._disperses, 1
        self._time, self._wavelengths = vertices._time, vertices._wavelengths

    @property
    def slot(self) -> mi.UInt32:
        return dr.arange(mi.UInt32, self.count)


class VertexCache(PackedVertices):
    """The vertices of some rounds of a light walk. The vertices of a path follow each other.

    Parameters:
        rounds: The vertices of each round. Their memory is given back.
        lanes: Number of paths.

    Attributes:
        first, number (mi.UInt32): The index of each path's first vertex, and its number of
            vertices.
    """

    def __init__(self, rounds: list[LightVertices], lanes: int) -> None:
        if len(rounds) == 1:
            self.number = _numbers(rounds[0]._lane_of(rounds[0].slot, mi.Bool(True)), lanes)
            self.first = dr.cumsum(self.number) - self.number
            super().__init__(rounds[0])
            return
        self._share_paths_of(rounds[-1])
        owners = [v._lane_of(v.slot, mi.Bool(True)) for v in rounds]
        numbers = [_numbers(lane, lanes) for lane in owners]
        self.number = sum(numbers[1:], numbers[0])
        self.first = dr.cumsum(self.number) - self.number
        self.count, words = sum(vertices.count for vertices in rounds), self._layout.words
        self.room = room_for(self.count)
        self._words = dr.empty(mi.Float, self.room * words)
        self._lane = dr.empty(mi.UInt32, self.room)
        before = mi.UInt32(self.first)
        for vertices, lane, number in zip(rounds, owners, numbers):
            # The first vertex of this path in this round
            begin = dr.cumsum(number) - number
            index = dr.arange(mi.UInt32, vertices.count)
            place = index - dr.gather(mi.UInt32, begin, lane) + dr.gather(mi.UInt32, before, lane)
            packet = dr.gather(
                mi.ArrayXf, vertices._words, vertices.slot, shape=(words, vertices.count)
            )
            dr.scatter(self._words, packet, place)
            dr.scatter(self._lane, lane, place)
            before = before + number
            dr.eval(self._words, self._lane, before)
            vertices._words = vertices._lane = None
        self.bytes = self.count * (4 * words + 4) + 8 * lanes

    def kernel_state(self) -> tuple:
        return super().kernel_state(), self.first, self.number

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


def _widened(values: mi.UInt32, width: int) -> mi.UInt32:
    """The values, followed by zeros up to ``width``."""
    index = dr.arange(mi.UInt32, width)
    result = dr.gather(mi.UInt32, values, index, index < dr.opaque(mi.UInt32, len(values)))
    dr.eval(result)
    return result


def _numbers(lane: mi.UInt32, lanes: int) -> mi.UInt32:
    """The number of vertices of each path. ``lane`` is the path of each vertex."""
    number = dr.zeros(mi.UInt32, lanes)
    dr.scatter_add(number, mi.UInt32(1), lane)
    return number


def _depth_and_region(mark: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Depth and region from the word that holds both, with 16 bits for the region."""
    return mark & ((1 << _DEPTH_BITS) - 1), (mark & (_HERO_IS_ALONE - 1)) >> _DEPTH_BITS
