"""A density of directions that lead to boxes in space.

Source: A. Rath, P. Grittmann, S. Herholz, P. Weier, P. Slusallek, *Focal Path Guiding for Light
Transport Simulation*, SIGGRAPH 2023, section 4.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON

#: Numbers that are stored for each box.
_ROW = 8

#: The least component of a direction that is divided by.
_LEAST = 1e-12


class FocalBoxes:
    """Chooses one of some boxes, a uniform point in it, and the direction to that point.

    Parameters:
        low, high: The corners of the boxes; shape [boxes, 3].
        weight: The probabilities of the boxes; shape [boxes].

    Attributes:
        count (int): Number of boxes.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, weight: np.ndarray) -> None:
        self.low, self.high = np.float32(low), np.float32(high)
        self.count = len(weight)
        cumulative = np.cumsum(np.float64(weight) / np.sum(weight))
        cumulative[-1] = 1
        self.cumulative = np.float32(cumulative)
        self._set()

    def _set(self) -> None:
        # The probabilities that the search realizes
        self.weight = np.diff(np.float64(self.cumulative), prepend=0)
        size = np.prod(np.float64(self.high) - self.low, axis=1)
        rows = np.zeros((self.count, _ROW), np.float32)
        rows[:, 0:3], rows[:, 4:7] = self.low, self.high
        rows[:, 3], rows[:, 7] = self.weight / (3 * size), self.cumulative
        self._rows = from_numpy(mi.Float, rows)
        self._count = dr.opaque(mi.UInt32, self.count)
        dr.eval(self._rows)

    @dr.syntax
    def sample(
        self, p: mi.Point3f, number: mi.Float, point: mi.Point2f, active: mi.Bool
    ) -> mi.Vector3f:
        """A direction from ``p`` to a point in one of the boxes."""
        first, last = mi.UInt32(0), self._count - 1
        while dr.hint(active & (first < last), label="choose a box"):
            middle = (first + last) // 2
            above = dr.gather(mi.Float, self._rows, middle * _ROW + 7, active) > number
            last = dr.select(above, middle, last)
            first = dr.select(above, first, middle + 1)
        below = dr.gather(mi.Float, self._rows, first * _ROW - 1, active & (first > 0))
        low, high, _, end = self._box(first, active)
        rest = dr.clip((number - below) / dr.maximum(end - below, 1e-30), 0, ONE_MINUS_EPSILON)
        q = low + mi.Vector3f(point.x, point.y, rest) * (high - low)
        d = q - p
        length = dr.norm(d)
        return dr.select(length > 0, d / length, mi.Vector3f(0, 0, 1))

    @dr.syntax
    def density(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The solid angle density of the direction ``d`` from ``p``."""
        index, total = mi.UInt32(0), mi.Float(0)
        inverse = _inverse(d)
        while dr.hint(active & (index < self._count), label="focal boxes"):
            low, high, scale, _ = self._box(index, active)
            total += scale * _seen(low - p, high - p, inverse)
            index += 1
        return total

    @dr.syntax
    def densities(
        self, p: mi.Point3f, d: mi.Vector3f, e: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """The densities of two directions from ``p``."""
        index, total, other = mi.UInt32(0), mi.Float(0), mi.Float(0)
        inverse, other_inverse = _inverse(d), _inverse(e)
        while dr.hint(active & (index < self._count), label="focal boxes of two directions"):
            low, high, scale, _ = self._box(index, active)
            low, high = low - p, high - p
            total += scale * _seen(low, high, inverse)
            other += scale * _seen(low, high, other_inverse)
            index += 1
        return total, other

    def _box(self, index: mi.UInt32, active: mi.Bool):
        row = dr.gather(mi.ArrayXf, self._rows, index, active, shape=(_ROW, dr.width(index))) if False else [
            dr.gather(mi.Float, self._rows, index * _ROW + i, active) for i in range(_ROW)
        ]
        return mi.Point3f(row[0:3]), mi.Point3f(row[4:7]), row[3], row[7]


def _inverse(d: mi.Vector3f) -> mi.Vector3f:
    """The reciprocal of each component; none is infinite."""
    return dr.rcp(dr.select(dr.abs(d) > _LEAST, d, _LEAST))


def _seen(low: mi.Vector3f, high: mi.Vector3f, inverse: mi.Vector3f) -> mi.Float:
    """The integral of 3 t² over the part of a ray that is in a box. The ray starts at the origin.
    """
    a, b = low * inverse, high * inverse
    enters, leaves = dr.max(dr.minimum(a, b)), dr.min(dr.maximum(a, b))
    enters = dr.maximum(enters, 0)
    # t1³ − t0³, without the difference of large numbers
    cubes = (leaves - enters) * (leaves * leaves + leaves * enters + enters * enters)
    return dr.select(leaves > enters, cubes, 0)
