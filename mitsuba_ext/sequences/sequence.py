"""What a sampler asks of a sequence of points."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi


class Sequence(Protocol):
    """Points of a few dimensions, of which each set of dimensions of a path is another random copy.

    Attributes:
        pairs: Half the number of its dimensions.
    """

    pairs: int

    def point(self, index: mi.UInt32, count: int, seed: mi.UInt32) -> mi.UInt32:
        """The number of the point that a sample takes, in an order that the seed makes random.

        Parameters:
            index: Of the sample.
            count: Samples per pixel of the render.
        """

    def coordinate(
        self, point: mi.UInt32, count: int, dimension: mi.UInt32, seed: mi.UInt32
    ) -> mi.Float:
        """A coordinate of a point, in [0, 1). Its distribution over all seeds is uniform.

        Parameters:
            point: As :meth:`point` returned it.
            dimension: Below 2 · ``pairs``.
            seed: Of this coordinate: it differs between dimensions, sets and pixels.
        """
