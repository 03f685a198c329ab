"""Weighted point sets in device memory, from which kernels draw.

Source: Guo, PhD thesis, section 4.5.2. Our addition: after a random shift around the torus, weights
that add up to one are unbiased in every dimension.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.pointsets import points, voronoi_weights

#: Values of the parameter ``weights``.
WEIGHTS = ("none", "voronoi", "torus", "unbiased")

#: Number of points of all sets together, and the largest number of sets. With few sets, many pixels
#: use the same set, and their errors are correlated.
_POINTS, _MOST_SETS = 1 << 13, 32

#: The pattern that is slow to generate, its number of sets, and the number of points per set beyond
#: which it takes ten seconds or more.
SLOW_PATTERN, _FEW_SETS, MOST_SLOW_POINTS = "poisson_disk", 2, 1024


class WeightedSets:
    """Several point sets of one kind. Each pixel, or each vertex of a path, chooses a set at random
    and, except with ``voronoi``, shifts it around the torus at random.

    Parameters:
        pattern: See :func:`mitsuba_ext.util.pointsets.points`.
        weights: ``none`` (1/N); ``voronoi`` (cells that end at the border: biased); ``torus``
            (periodic cells); ``unbiased`` (periodic cells, and points mapped by
            :func:`mitsuba_ext.util.pointsets.tent`, which removes the discontinuity at the border).
        count: Points of a set, N.
        dimension: 1 or 2.
        seed: One or several integers.
        periods: If larger than 1 (in one dimension only), points have a second weight, for
            integrands of the period 1 / periods: it is computed from positions modulo this period.
    """

    def __init__(
        self,
        pattern: str,
        weights: str,
        count: int,
        dimension: int,
        seed: Any,
        periods: int = 1,
    ) -> None:
        self.count, self._kind, self._dimension = count, weights, dimension
        self._weight_count = 1 if periods == 1 else 2
        most = _FEW_SETS if pattern == SLOW_PATTERN else _MOST_SETS
        self._set_count = min(max(2, _POINTS // count), most)
        rng = np.random.default_rng(seed)
        # Rows have two or four numbers, so that one gather reads them
        columns = dimension + self._weight_count
        table = np.ones((self._set_count, count, columns + columns % 2), np.float32)
        for rows in table:
            x = points(pattern, count, dimension, rng)
            # Without the shuffle, their order could be correlated with the film's sampler
            rng.shuffle(x)
            rows[:, :dimension] = x
            if weights != "none":
                rows[:, dimension] = count * voronoi_weights(x, _BOUNDARIES[weights])
                if periods > 1:
                    rows[:, dimension + 1] = _periodic_weights(x, periods)
        self._table = from_numpy(mi.Float, table)
        self._opaque_count, self._opaque_sets = (
            dr.opaque(mi.UInt32, n) for n in (count, self._set_count)
        )
        dr.eval(self._table)

    def choose(self, sample: mi.Float) -> mi.UInt32:
        """The index of a set, chosen by a uniform number in [0, 1)."""
        sets = self._opaque_sets
        return dr.minimum(mi.UInt32(sample * mi.Float(sets)), sets - 1)

    def draw(
        self, number: mi.UInt32, shift: mi.Point2f, index: mi.UInt32, active: mi.Bool
    ) -> tuple[Any, ...]:
        """The point ``index`` of a set, its weight times N, and with ``periods`` its second weight
        times N. With ``none``, the weights are 1.0.

        Parameters:
            number: Index of the set.
            shift: Shift around the torus, in [0, 1)ᴰ; ignored with ``voronoi``.
            index: Index of the point, below N.
        """
        row = number * self._opaque_count + index
        columns = self._dimension + self._weight_count
        entry = dr.gather(mi.Point2f if columns == 2 else mi.Vector4f, self._table, row, active)
        if self._dimension == 1:
            u, shift = entry.x, shift.x
        else:
            u = mi.Point2f(entry.x, entry.y)
        if self._kind != "voronoi":
            u += shift
            u -= dr.floor(u)
        if self._kind == "unbiased":
            u = 1 - dr.abs(2 * u - 1)
        # Points stay below 1 despite rounding
        u = dr.minimum(u, dr.one_minus_epsilon(mi.Float))
        weights = [entry[self._dimension + i] for i in range(self._weight_count)]
        return (u, *([1.0] * len(weights) if self._kind == "none" else weights))


def _periodic_weights(x: np.ndarray, periods: int) -> np.ndarray:
    # Points that differ by rounding only share a cell. No weight is zero, because the two weights
    # of a point are divided by each other
    place = np.round(x.ravel() * periods % 1, 9) % 1
    return np.maximum(len(x) * voronoi_weights(place), 1e-6)


_BOUNDARIES = {"voronoi": "clip", "torus": "torus", "unbiased": "torus"}
