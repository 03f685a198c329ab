"""Weighted point sets on the device, and how a kernel draws from them.

Source: Guo, PhD thesis, section 4.5.2; that a random shift around the torus makes weights that add
up to one unbiased in every dimension is ours.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..pointsets import points, voronoi_weights

#: How the points of a set are weighed.
WEIGHTS = ("none", "voronoi", "torus", "unbiased")

#: Points of all sets together, and sets at most. With few sets, pixels share the luck of one.
_POINTS, _MOST_SETS = 1 << 13, 32

#: A pattern whose points are slow to find; more of them than this take ten seconds.
SLOW_PATTERN, _FEW_SETS, MOST_SLOW_POINTS = "poisson_disk", 2, 1024


class WeightedSets:
    """Some point sets of one kind. Each user of a set (a pixel, a vertex of a path) chooses one at
    random and, but for ``voronoi``, shifts it around the torus at random.

    Parameters:
        pattern: See :func:`mitsuba_ext.pointsets.points`.
        weights: ``none`` (1/N); ``voronoi`` (cells that end at the border: biased); ``torus``
            (periodic cells); ``unbiased`` (the same, and the points are folded: no seam).
        count: Points of a set, N.
        dimension: 1 or 2.
        seed: Another seed (an integer, or several) gives other sets.
        periods: With more than 1, in one dimension: points get a second weight, for integrands that
            repeat themselves so often in [0, 1). Their place counts modulo 1 / periods.
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
        # Rows of two or four numbers are read at once
        columns = dimension + self._weight_count
        table = np.ones((self._set_count, count, columns + columns % 2), np.float32)
        for rows in table:
            x = points(pattern, count, dimension, rng)
            # Their order must not be that of another sampler
            rng.shuffle(x)
            rows[:, :dimension] = x
            if weights != "none":
                rows[:, dimension] = count * voronoi_weights(x, _BOUNDARIES[weights])
                if periods > 1:
                    rows[:, dimension + 1] = _periodic_weights(x, periods)
        self._table = mi.Float(np.ascontiguousarray(table.ravel()))
        self._opaque_count, self._opaque_sets = (
            dr.opaque(mi.UInt32, n) for n in (count, self._set_count)
        )
        dr.eval(self._table)

    def choose(self, sample: mi.Float) -> mi.UInt32:
        """One of the sets, for a number in [0, 1)."""
        sets = self._opaque_sets
        return dr.minimum(mi.UInt32(sample * mi.Float(sets)), sets - 1)

    def draw(
        self, number: mi.UInt32, shift: mi.Point2f, index: mi.UInt32, active: mi.Bool
    ) -> tuple[Any, ...]:
        """The point ``index`` of a set, its weight times N, and with ``periods`` its second weight
        times N. The weights are 1.0 where there are none.

        Parameters:
            number: Which set.
            shift: In [0, 1)ᴰ.
            index: Below N.
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
        # Rounding must not reach the upper end
        u = dr.minimum(u, dr.one_minus_epsilon(mi.Float))
        weights = [entry[self._dimension + i] for i in range(self._weight_count)]
        return (u, *([1.0] * len(weights) if self._kind == "none" else weights))


def _periodic_weights(x: np.ndarray, periods: int) -> np.ndarray:
    # Points that differ by rounding only must share their cell. None weighs nothing: weights of
    # both kinds are divided by each other
    place = np.round(x.ravel() * periods % 1, 9) % 1
    return np.maximum(len(x) * voronoi_weights(place), 1e-6)


_BOUNDARIES = {"voronoi": "clip", "torus": "torus", "unbiased": "torus"}
