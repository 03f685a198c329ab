"""Points of the lens, from the centre to the edge."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .images import LevelView, Pyramid

#: The number of points in each ring, innermost first. Every point represents the same area.
RINGS = (8, 16, 24)


def ring_points(rings: tuple[int, ...] = RINGS) -> np.ndarray:
    """Points of the unit disk, [point, 2]: rings around its centre, each at the middle (by area) of
    an annulus whose area is proportional to its number of points.

    The mean of the points is 0. The default of 48 points in three rings is from J. J. Guo, PhD
    thesis, TU Delft, section 5.4.1.2.
    """
    ends = np.cumsum([0, *rings]) / sum(rings)
    points = []
    for i, count in enumerate(rings):
        radius = np.sqrt((ends[i] + ends[i + 1]) / 2)
        # Rotates every second ring, so that points of neighbouring rings are not aligned
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (i % 2)) / count
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


class LensPoints:
    """A table of points of the unit disk.

    Parameters:
        points: The points, [point, 2].
    """

    def __init__(self, points: np.ndarray) -> None:
        self._table = from_numpy(mi.Float, points)
        self.count = dr.opaque(mi.UInt32, len(points))
        # Half the distance between neighbours, in radii
        self._step = 0.5 * math.sqrt(math.pi / len(points))

    def at(self, i: mi.UInt32) -> mi.Point2f:
        return dr.gather(mi.Point2f, self._table, i)

    def view(self, pyramid: Pyramid, radius: mi.Float) -> LevelView:
        """The level of a pyramid whose pixels are half as large as the distance between the points
        on a disk of this radius, so that little is missed between the points."""
        level = dr.round(dr.log2(dr.maximum(self._step * dr.abs(radius), 1)))
        return pyramid.view(mi.UInt32(dr.minimum(level, pyramid.level_count - 1)))


@dr.syntax
def disk_mean(points: LensPoints, view: LevelView, middle: mi.Point2f, radius: mi.Float):
    """The mean of an image over a disk around each pixel.

    Parameters:
        view: The level of the image's pyramid to read.
        middle, radius: The centre (from the corner of the image) and the radius, in pixels.
    """
    i, total = mi.UInt32(0), mi.Vector4f(0)
    while i < points.count:
        total += view.at(middle + radius * points.at(i))
        i += 1
    return total / mi.Float(points.count)
