"""The interface of point sequences, as samplers use it."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi


class Sequence(Protocol):
    """A sequence of points in a few dimensions. Each set of dimensions of a path uses a different
    random copy of it.

    Attributes:
        pairs: Half the number of its dimensions.
    """

    pairs: int

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        """The index of the point that a sample takes, in a random order that the seed chooses.

        Parameters:
            index: Index of the sample.
            count: Samples per pixel of the render.
        """

    def coordinate(
        self, point: mi.UInt32, count: int, dimension: mi.UInt32, seed: mi.UInt32
    ) -> mi.Float:
        """A coordinate of a point, in [0, 1). Its distribution over all seeds is uniform.

        Parameters:
            point: The result of :meth:`point`.
            dimension: Below 2 · ``pairs``.
            seed: Seed of this coordinate. It differs between dimensions, sets and pixels.
        """
