"""Choosing the stored vertices of light paths to which a camera path vertex is connected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.path_decisions import SubpathSelection
from ...transport.vertex import Vertex
from ...util.arrays import from_numpy
from .light_vertices import VertexCache


@dataclass
class Chosen:
    """A vertex that was chosen.

    Attributes:
        index: Its index among the stored vertices.
        factor: The weight of the connection: 1 / (probability · number of light paths).
        active: Lanes in which there was a vertex to choose.
        expected: For MIS weights: :meth:`SubpathSelection.expected` for the chosen region.
        region, probability: The region that was chosen, and the probability of choosing it;
            ``None`` if vertices are not chosen by regions.
    """

    index: mi.UInt32
    factor: mi.Float
    active: mi.Bool
    expected: mi.Float | float = 1.0
    region: Any = None
    probability: Any = None


class VertexChoice:
    """Chooses among all vertices, uniformly.

    Parameters:
        vertices: The stored vertices, at least one.
    """

    def __init__(self, vertices: VertexCache) -> None:
        self._vertices = vertices
        self._count = dr.opaque(mi.UInt32, vertices.count)
        self._mean = dr.opaque(mi.Float, vertices.count / vertices.paths)

    def numbers(self, sampler: mi.Sampler) -> tuple[mi.Point2f, ...]:
        """The random numbers that choose a vertex."""
        return (sampler.next_2d(),)

    def choose(
        self, numbers: tuple[mi.Point2f, ...], vertex: Vertex, active: mi.Bool
    ) -> Chosen:
        """Chooses a stored vertex for each ``vertex``."""
        return Chosen(below(self._count, numbers[0]), self._mean, active & (self._count > 0))


class OwnVertexChoice(VertexChoice):
    """Chooses among the vertices of the light path in the same lane, uniformly."""

    def __init__(self, vertices: VertexCache) -> None:
        super().__init__(vertices)
        self._lane = dr.arange(mi.UInt32, vertices.paths)

    def choose(self, numbers, vertex, active):
        number = dr.gather(mi.UInt32, self._vertices.number, self._lane, active)
        first = dr.gather(mi.UInt32, self._vertices.end, self._lane, active) - number
        return Chosen(first + below(number, numbers[0]), mi.Float(number), active & (number > 0))


class RegionChoice(VertexChoice):
    """Chooses a region, then among the vertices that lie there, uniformly.

    Parameters:
        selection: Chooses regions.
    """

    def __init__(self, vertices: VertexCache, selection: SubpathSelection) -> None:
        super().__init__(vertices)
        self._selection = selection
        region = vertices.region
        # A stable sort, so that the order is the same in each render
        self._order = from_numpy(mi.UInt32, np.argsort(_small(region), kind="stable"))
        number = dr.zeros(mi.UInt32, selection.count)
        dr.scatter_add(number, mi.UInt32(1), region)
        self._range = mi.ArrayXu([dr.cumsum(number) - number, number])
        self._range = dr.ravel(self._range)
        self._share = dr.opaque(mi.Float, 1 / vertices.paths)
        dr.eval(self._order, self._range)

    def numbers(self, sampler):
        return sampler.next_2d(), sampler.next_2d()

    def choose(self, numbers, vertex, active):
        mine = vertex.path.history.region
        region, probability = self._selection.choose(numbers[0], mine, active)
        first, number = dr.gather(mi.Vector2u, self._range, region, active)
        place = first + below(number, numbers[1])
        exists = active & (number > 0)
        return Chosen(
            dr.gather(mi.UInt32, self._order, place, exists),
            mi.Float(number) * self._share / dr.select(active, probability, 1),
            exists, self._selection.expected(mine, region, active), region, probability,
        )  # fmt: skip


def below(number: mi.UInt32, sample: mi.Point2f) -> mi.UInt32:
    """A uniformly chosen integer below ``number``. It takes two random numbers, since one has only
    24 bits and ``number`` may be larger."""
    bits = (mi.UInt32(sample.x * 65536) << 16) | mi.UInt32(sample.y * 65536)
    return mi.UInt32((mi.UInt64(bits) * mi.UInt64(number)) >> 32)


def _small(region: mi.UInt32) -> np.ndarray:
    """The regions as 16-bit integers, which NumPy sorts by a fast radix sort."""
    return region.numpy().astype(np.uint16)
