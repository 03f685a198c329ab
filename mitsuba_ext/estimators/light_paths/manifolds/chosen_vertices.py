"""The vertices of camera paths that are connected to lights through casters: one of each path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.numbers import hashed_2d
from ....transport.path_program import Subpaths
from ....transport.vertex import Vertex
from ..stored_interaction import as_float, from_words, interaction_words, to_words

#: The bits of a random number. Seeds of 24 bits would repeat in large renders.
_BITS = 24

#: The number of the hash by which a vertex is chosen.
_CHOICE = 0xFFFFFFFF


@dataclass
class ChosenVertex:
    """The vertex of a path that is connected.

    Attributes:
        si: The interaction.
        β: Throughput / probability of the choice.
        depth: The depth.
        seed: The seed of the random numbers of its connection.
        exists: Whether there is any.
        events: The states of light path expressions.
    """

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum
    depth: mi.UInt32
    seed: mi.UInt32
    exists: mi.Bool
    events: list[mi.UInt32]


class ChosenVertices(Subpaths):
    """Chooses one vertex of each path in proportion to its throughput.

    Searching for a chain takes longer than a path, and is done once for all vertices: the choice is
    a reservoir with a single place (M. Chao, *A General Purpose Unequal Probability Sampling Plan*,
    Biometrika 69(3), 1982).

    Parameters:
        lanes: Number of paths.
        connects: Tells whether a vertex has connections through casters.
        is_whole: Whether all fields of an interaction are stored.
        stride: One in ``stride`` paths is connected.
        events: The number of states that light path expressions keep of a path; 0 without any.
    """

    def __init__(
        self, lanes: int, connects: Callable[[Vertex], mi.Bool], is_whole: bool,
        stride: mi.UInt32, events: int = 0,
    ) -> None:
        self._stride = stride
        self._connects, self._is_whole, self._events = connects, is_whole, events
        self._channels = dr.size_v(mi.Spectrum)
        self._size = self._channels + 3 + interaction_words(is_whole) + events
        self._words = dr.empty(mi.Float, lanes * self._size)
        self._totals = dr.zeros(mi.Float, lanes)

    def gather(self, scene, sampler, vertex, active):
        x, y = (mi.UInt32(u * 2.0**_BITS) for u in sampler.next_2d())
        seed = x ^ (y << (32 - _BITS))
        h, importance = vertex.path.history, self.importance(vertex)
        total = h.total + importance
        active = active & (importance > 0)
        taken = active & (hashed_2d(seed, mi.UInt32(_CHOICE)).x * total <= importance)
        self._store(vertex, importance, seed, taken)
        dr.scatter(self._totals, total, h.lane, active)
        return mi.Spectrum(0), mi.UInt32(0)

    @dr.syntax
    def _store(
        self, vertex: Vertex, importance: mi.Float, seed: mi.UInt32, taken: mi.Bool
    ) -> None:
        """Stores a vertex."""
        # A branch: the deeper a vertex lies, the more rarely it is taken
        if dr.hint(taken, label="chosen vertices"):
            words = [*vertex.path.β, importance, as_float(seed), as_float(vertex.depth)]
            words += to_words(vertex.si, self._is_whole)
            words += [as_float(state) for state in vertex.path.events or ()]
            dr.scatter(self._words, mi.ArrayXf(words), vertex.path.history.lane, taken)

    def importance(self, vertex: Vertex) -> mi.Float:
        """The importance of a vertex; 0 where it has no connections through casters."""
        connects = self._connects(vertex) & self.is_connected(vertex.path.history.lane)
        return dr.select(connects, dr.max(vertex.path.β), 0)

    def is_connected(self, path: mi.UInt32) -> mi.Bool:
        """Whether a vertex of this path is connected."""
        return path % self._stride == 0

    def schedule(self) -> None:
        """Schedules what is stored for evaluation."""
        dr.schedule(self._words, self._totals)

    def load(
        self, path: mi.UInt32, active: mi.Bool
    ) -> ChosenVertex:
        """The chosen vertex of a path."""
        total = dr.gather(mi.Float, self._totals, path, active)
        exists = active & (total > 0)
        shape = self._size, dr.width(path)
        w = dr.gather(mi.ArrayXf, self._words, path, exists, shape=shape)
        β, (importance, seed, depth, *words) = (
            mi.Spectrum(*(w[i] for i in range(self._channels))),
            (w[i] for i in range(self._channels, self._size)),
        )
        β *= dr.select(exists, total / importance, 0)
        seed, depth = (dr.reinterpret_array(mi.UInt32, word) for word in (seed, depth))
        events = [dr.reinterpret_array(mi.UInt32, w) for w in words[len(words) - self._events :]]
        si = from_words(words[: len(words) - self._events], self._is_whole)
        return ChosenVertex(si, β, depth, seed, exists, events)
