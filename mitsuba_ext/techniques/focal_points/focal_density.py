"""The density of directions that lead to boxes in space.

Source: A. Rath, P. Grittmann, S. Herholz, P. Weier, P. Slusallek, *Focal Path Guiding for Light
Transport Simulation*, SIGGRAPH 2023. There, the boxes are the leaves of an octree, and have the
same probabilities everywhere.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from ...util.stored_arrays import StoredArrays

#: The most boxes and rows of a stored density.
_MOST_BOXES, _MOST_ROWS = 1 << 10, 1 << 16

#: The least component of a direction by which something is divided.
_LEAST = 1e-12


class FocalDensity:
    """Chooses one of some boxes, a uniform point in it, and the direction to that point.

    Along a direction, the density is the sum over the boxes of probability / volume · ∫ t² dt, over
    the part of the ray that lies in the box. Boxes may overlap.

    Parameters:
        low, high: The corners of the boxes; shape [boxes, 3].
        probability: In each row, the probability of each box; the rest of the samples are for
            others. Shape [rows, boxes].

    Attributes:
        count (int): Number of boxes.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, probability: np.ndarray) -> None:
        share = np.sum(probability, axis=1, dtype=np.float64)
        running = np.cumsum(probability, axis=1, dtype=np.float64)
        running /= np.maximum(running[:, -1:], 1e-30)
        # Of each row, the share of its samples that go to boxes comes first
        table = np.column_stack([share, np.minimum(running, 1)])
        table[:, -1] = 1
        self._set(np.float32(low), np.float32(high), np.float32(table))

    def _set(self, low: np.ndarray, high: np.ndarray, table: np.ndarray) -> None:
        self.low, self.high, self.table, self.count = low, high, table, len(low)
        boxes = np.zeros((self.count, 8), np.float32)
        boxes[:, 0:3], boxes[:, 4:7] = low, high
        boxes[:, 3] = 1 / (3 * np.prod(np.float64(high) - low, axis=1))
        self._boxes, self._table = from_numpy(mi.Float, boxes), from_numpy(mi.Float, table)
        # Opaque: densities of other sizes share the kernels
        self._count = dr.opaque(mi.UInt32, self.count)
        dr.eval(self._boxes, self._table)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self._boxes, self._table, self._count

    @classmethod
    def nothing(cls, rows: int) -> FocalDensity:
        """A density whose rows choose no box."""
        return cls(np.zeros((1, 3)), np.ones((1, 3)), np.zeros((rows, 1)))

    @property
    def has_boxes(self) -> bool:
        """Whether a row chooses one."""
        return bool(self.table[:, 0].any())

    def state(self) -> dict[str, np.ndarray]:
        """The density as arrays."""
        return {"low": self.low, "high": self.high, "table": self.table}

    @classmethod
    def of_state(cls, state: StoredArrays, rows: int) -> FocalDensity:
        """The density from the arrays of :meth:`state`.

        Raises:
            DamagedError: They are no density of as many rows.
        """
        low = state.take("low", "f", (None, 3), longest=3 * _MOST_BOXES)
        high = state.take("high", "f", low.shape)
        table = state.take("table", "f", (rows, len(low) + 1), 0, 1, longest=1 << 26)
        state.require(len(low) > 0 and bool((high > low).all()), "a box without a volume")
        rises = (np.diff(table[:, 1:], axis=1) >= 0).all() and (table[:, -1] == 1).all()
        state.require(bool(rises), '"table" is not rising')
        density = cls.__new__(cls)
        density._set(low, high, table)
        return density

    def share(self, row: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The share of the samples of a row that go to boxes."""
        return dr.gather(mi.Float, self._table, row * (self._count + 1), active)

    @dr.syntax
    def sample(
        self, row: mi.UInt32, p: mi.Point3f, number: mi.Float, point: mi.Point2f, active: mi.Bool
    ) -> mi.Vector3f:
        """A direction from ``p`` to a point in one of the boxes; ``number`` and ``point`` are
        uniform."""
        start = row * (self._count + 1)
        first, last = start + 1, start + self._count
        while dr.hint(active & (first < last), label="choose a box"):
            middle = (first + last) // 2
            is_above = dr.gather(mi.Float, self._table, middle, active) > number
            last = dr.select(is_above, middle, last)
            first = dr.select(is_above, first, middle + 1)
        below = dr.gather(mi.Float, self._table, first - 1, active & (first > start + 1))
        end = dr.gather(mi.Float, self._table, first, active)
        low, high, _ = self._box(first - start - 1, active)
        rest = (number - below) / dr.maximum(end - below, 1e-30)
        rest = dr.clip(rest, 0, ONE_MINUS_EPSILON)
        d = dr.fma(mi.Vector3f(point.x, point.y, rest), high - low, low) - p
        length = dr.norm(d)
        return dr.select(length > 0, d / length, mi.Vector3f(0, 0, 1))

    def density(
        self, row: mi.UInt32, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool
    ) -> mi.Float:
        """The solid angle density of the direction ``d`` from ``p``."""
        return self.densities(row, p, (d,), active)[0]

    @dr.syntax
    def densities(
        self, row: mi.UInt32, p: mi.Point3f, directions: tuple[mi.Vector3f, ...], active: mi.Bool
    ) -> tuple[mi.Float, ...]:
        """The solid angle densities of some directions from ``p``."""
        index, below = mi.UInt32(0), mi.Float(0)
        start = row * (self._count + 1) + 1
        inverses, totals = [_inverse(d) for d in directions], [mi.Float(0)] * len(directions)
        while dr.hint(active & (index < self._count), label="boxes"):
            low, high, scale = self._box(index, active)
            low, high = low - p, high - p
            above = dr.gather(mi.Float, self._table, start + index, active)
            totals = _with_box(totals, (above - below) * scale, low, high, inverses)
            below = above
            index += 1
        return tuple(totals)

    def _box(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.Point3f, mi.Point3f, mi.Float]:
        """The corners of a box, and 1 / (3 · volume)."""
        low = dr.gather(mi.Vector4f, self._boxes, 2 * index, active)
        high = dr.gather(mi.Vector4f, self._boxes, 2 * index + 1, active)
        return mi.Point3f(low.x, low.y, low.z), mi.Point3f(high.x, high.y, high.z), low.w


def _with_box(totals, scale, low, high, inverses) -> list[mi.Float]:
    """The densities with one box more."""
    return [dr.fma(scale, _seen(low, high, x), total) for x, total in zip(inverses, totals)]


def _inverse(d: mi.Vector3f) -> mi.Vector3f:
    """The reciprocal of each component; none is infinite."""
    return dr.rcp(dr.select(dr.abs(d) > _LEAST, d, _LEAST))


def _seen(low: mi.Vector3f, high: mi.Vector3f, inverse: mi.Vector3f) -> mi.Float:
    """3 · ∫ t² dt over the part of a ray from the origin that lies in a box."""
    a, b = low * inverse, high * inverse
    enters = dr.maximum(dr.max(dr.minimum(a, b)), 0)
    leaves = dr.min(dr.maximum(a, b))
    # t₁³ − t₀³, without a difference of large numbers
    cubes = (leaves - enters) * dr.fma(leaves, leaves + enters, enters * enters)
    return dr.select(leaves > enters, cubes, 0)
