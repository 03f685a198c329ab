"""Sums of an environment's emission over rectangles of texels, and sampling in proportion to the
emission times a function given at the corners of a rectangle.

Source: Cline, PhD dissertation, section 5.2.1 and appendix 5A.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .environment_texels import EnvironmentTexels


@dataclass
class Corners:
    """Values at the corners of a rectangle: at (x0, y0), (x1, y0), (x0, y1) and (x1, y1)."""

    v00: mi.Float
    v10: mi.Float
    v01: mi.Float
    v11: mi.Float

    @property
    def mean(self) -> mi.Float:
        return 0.25 * (self.v00 + self.v10 + self.v01 + self.v11)

    def divided(self, by_x: mi.Bool, low: mi.Float, high: mi.Float) -> tuple[Corners, Corners]:
        """The values at the corners of both halves.

        Parameters:
            by_x: Whether the rectangle is divided across x instead of y.
            low, high: The values at the ends of the dividing line.
        """
        kind = type(self)
        return (
            kind(
                self.v00, dr.select(by_x, low, self.v10), dr.select(by_x, self.v01, low), high
            ),
            kind(
                low, dr.select(by_x, self.v10, high), dr.select(by_x, high, self.v01), self.v11
            ),
        )


@dataclass
class CornerSums(Corners):
    """Values at the corners of a rectangle, in double precision."""

    v00: mi.Float64
    v10: mi.Float64
    v01: mi.Float64
    v11: mi.Float64


@dataclass
class Rectangle:
    """Texels x0 ≤ x < x1, y0 ≤ y < y1.

    Attributes:
        f: The values of a function at the corners.
        sums: The summed-area table of the emission at the corners, relative to the total emission;
            in double precision: dark texels beside a sun are small differences of large sums.
    """

    x0: mi.UInt32
    y0: mi.UInt32
    x1: mi.UInt32
    y1: mi.UInt32
    f: Corners
    sums: CornerSums

    @property
    def share(self) -> mi.Float:
        """The fraction of the total emission that the texels have."""
        s = self.sums
        # Sums grow along each row and column; only rounding could make the difference negative
        return mi.Float(dr.maximum((s.v11 - s.v01) - (s.v10 - s.v00), 0))

    @property
    def weight(self) -> mi.Float:
        """Eq. 5.5 (Cline): the emission of the texels times the mean of the function."""
        return self.share * self.f.mean


class TexelSums:
    """A summed-area table in double precision: single precision would lose the dark texels beside
    a sun.

    Parameters:
        texels: The emission.
    """

    def __init__(self, texels: EnvironmentTexels) -> None:
        self.texels = texels
        node = texels.nodes()
        weight = 0.25 * (node[:-1, :-1] + node[:-1, 1:] + node[1:, :-1] + node[1:, 1:])
        sums = np.zeros(node.shape)
        sums[1:, 1:] = weight.cumsum(axis=0).cumsum(axis=1)
        #: The integral of the brightness over the sphere, without a sun that is a disk.
        self.emission = float(sums[-1, -1]) * texels.area / (texels.columns * texels.rows)
        self._sums = from_numpy(mi.Float64, sums / sums[-1, -1])
        self._nodes = from_numpy(mi.Float, node / node.max())
        self._stride = dr.opaque(mi.UInt32, texels.columns + 1)
        #: The factor from the probability of a texel to a density on the sphere, without 1 / sin θ.
        self._density = dr.opaque(mi.Float, texels.columns * texels.rows / texels.area)

    def rectangle(
        self,
        x0: mi.UInt32,
        y0: mi.UInt32,
        x1: mi.UInt32,
        y1: mi.UInt32,
        f: Corners,
        active: mi.Bool,
    ) -> Rectangle:
        """A rectangle of texels, with a function given at its corners."""
        corners = ((x0, y0), (x1, y0), (x0, y1), (x1, y1))
        return Rectangle(
            x0, y0, x1, y1, f, CornerSums(*(self._sum(x, y, active) for x, y in corners))
        )

    def _sum(self, x, y, active) -> mi.Float64:
        return dr.gather(mi.Float64, self._sums, y * self._stride + x, active)

    @dr.syntax
    def sample(
        self, inside: Rectangle, point: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Point2f, mi.Float]:
        """A direction in a rectangle.

        Returns:
            The direction (in world space), its ``uv``, and its density in the rectangle.
        """
        probability, point = mi.Float(1), mi.Point2f(point)
        while dr.hint(active & _is_divisible(inside), label="warp"):
            by_x, low, high, of_low = self._halves(inside, active)
            number = dr.select(by_x, point.x, point.y)
            is_low = number < of_low
            of_side = dr.select(is_low, of_low, 1 - of_low)
            # The chosen side has a positive probability
            number = dr.minimum(
                (number - dr.select(is_low, 0, of_low)) / of_side, ONE_MINUS_EPSILON
            )
            point = mi.Point2f(
                dr.select(by_x, number, point.x), dr.select(by_x, point.y, number)
            )
            probability *= of_side
            inside = dr.select(is_low, low, high)
        point, density = mi.warp.square_to_bilinear(*self._corners(inside, active), point)
        texel = inside.y0 * (self._stride - 1) + inside.x0
        d, sin_theta, uv = self.texels.direction(texel, point)
        return d, uv, dr.select(active, probability * density * self._density / sin_theta, 0)

    @dr.syntax
    def invert(
        self,
        inside: Rectangle,
        column: mi.UInt32,
        row: mi.UInt32,
        point: mi.Point2f,
        sin_theta: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Point2f, mi.Float]:
        """The random numbers that :meth:`sample` maps to a direction in a rectangle, and the
        density of that direction. The direction is given by the results of
        :meth:`EnvironmentTexels.find`."""
        probability, first, size = mi.Float(1), mi.Point2f(0), mi.Point2f(1)
        while dr.hint(active & _is_divisible(inside), label="warp back"):
            by_x, low, high, of_low = self._halves(inside, active)
            is_low = dr.select(by_x, column < low.x1, row < low.y1)
            of_side = dr.select(is_low, of_low, 1 - of_low)
            first, size = part_of(first, size, by_x, is_low, of_side)
            probability *= of_side
            inside = dr.select(is_low, low, high)
        number, density = mi.warp.bilinear_to_square(*self._corners(inside, active), point)
        density = probability * density * self._density / sin_theta
        return first + size * number, dr.select(active, density, 0)

    def middle(
        self, r: Rectangle, by_x: mi.Bool
    ) -> tuple[tuple[mi.UInt32, mi.UInt32], tuple[mi.UInt32, mi.UInt32]]:
        """The ends of the line that divides a rectangle across x, or across y."""
        x, y = (r.x0 + r.x1) // 2, (r.y0 + r.y1) // 2
        return (
            (dr.select(by_x, x, r.x0), dr.select(by_x, r.y0, y)),
            (dr.select(by_x, x, r.x1), dr.select(by_x, r.y1, y)),
        )

    def divide(
        self, r: Rectangle, by_x: mi.Bool, f_low: mi.Float, f_high: mi.Float, active: mi.Bool
    ) -> tuple[Rectangle, Rectangle]:
        """Both halves of a rectangle.

        Parameters:
            f_low, f_high: The function at the ends of the dividing line.
        """
        low, high = self.middle(r, by_x)
        sums = (self._sum(x, y, active) for x, y in (low, high))
        f, sums = r.f.divided(by_x, f_low, f_high), r.sums.divided(by_x, *sums)
        return (
            Rectangle(r.x0, r.y0, *high, f[0], sums[0]),
            Rectangle(*low, r.x1, r.y1, f[1], sums[1]),
        )

    def _halves(self, r: Rectangle, active):
        """Divides a rectangle across its longer side and interpolates the function. Returns whether
        it is divided across x, the halves, and the probability of the first one."""
        width, height = r.x1 - r.x0, r.y1 - r.y0
        by_x = width > height
        # The dividing line is not in the middle if the number of texels is odd
        side = dr.select(by_x, width, height)
        t = mi.Float(side // 2) / mi.Float(side)
        f_low = dr.lerp(r.f.v00, dr.select(by_x, r.f.v10, r.f.v01), t)
        f_high = dr.lerp(dr.select(by_x, r.f.v01, r.f.v10), r.f.v11, t)
        low, high = self.divide(r, by_x, f_low, f_high, active)
        a, b = low.weight, high.weight
        # Shares and function are positive, but may underflow
        return by_x, low, high, dr.select(a + b > 0, a / (a + b), 0.5)

    def _corners(self, inside, active) -> list[mi.Float]:
        """The emission at the corners of a texel, relative to their mean."""
        first = inside.y0 * self._stride + inside.x0
        values = [
            dr.select(active, dr.gather(mi.Float, self._nodes, first + i, active), 1)
            for i in (0, 1, self._stride, self._stride + 1)
        ]
        # All are positive
        mean = 0.25 * (values[0] + values[1] + values[2] + values[3])
        return [value / mean for value in values]


def part_of(
    first: mi.Point2f, size: mi.Point2f, by_x: mi.Bool, is_low: mi.Bool, share: mi.Float
) -> tuple[mi.Point2f, mi.Point2f]:
    """Narrows a range of random numbers that lead to a rectangle to those that lead to one of its
    halves. A range is given by its smallest values and its size.

    Parameters:
        by_x: Whether the halves lie side by side along x.
        is_low: Whether the half is the first one.
        share: The probability of the half.
    """
    first = first + dr.select(is_low, mi.Point2f(0), size) * _along(by_x, 1 - share, 0)
    return first, size * _along(by_x, share, 1)


def _along(by_x: mi.Bool, value: mi.Float, other: float) -> mi.Point2f:
    return mi.Point2f(dr.select(by_x, value, other), dr.select(by_x, other, value))


def _is_divisible(r: Rectangle) -> mi.Bool:
    return (r.x1 - r.x0 > 1) | (r.y1 - r.y0 > 1)
