"""Weighted point sets on the device, and how a kernel draws from them.

Source: Guo, PhD thesis, section 4.5.2; that a random shift around the torus makes weights that add
up to one unbiased in every dimension is ours.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..parameters import read_parameter
from ..pointsets import PATTERNS, points, voronoi_weights

#: How the points of a set are weighed.
WEIGHTS = ("none", "voronoi", "torus", "unbiased")

#: Points of all sets together, and sets at most. With few sets, pixels share the luck of one.
_POINTS, _MOST_SETS = 1 << 13, 32

#: A pattern whose points are slow to find.
_SLOW, _FEW_SETS = "poisson_disk", 2


class SetKind:
    """The parameters ``pattern`` and ``weights`` of a plugin.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    def __init__(self, plugin: str, props: mi.Properties, pattern: str, weights: str) -> None:
        self.pattern = read_parameter(plugin, props, "pattern", pattern, choices=PATTERNS)
        self.weights = read_parameter(plugin, props, "weights", weights, choices=WEIGHTS)

    def sets(self, count: int, dimension: int, seed: int) -> WeightedSets:
        """Sets of ``count`` points; another seed gives others."""
        return WeightedSets(self.pattern, self.weights, count, dimension, seed)


class WeightedSets:
    """Some point sets of one kind. Each user of a set (a pixel, a vertex of a path) chooses one at
    random and, but for ``voronoi``, shifts it around the torus at random.

    Parameters:
        pattern: See :func:`mitsuba_ext.pointsets.points`.
        weights: ``none`` (1/N); ``voronoi`` (cells that end at the border: biased); ``torus``
            (periodic cells); ``unbiased`` (the same, and the points are folded: no seam).
        count: Points of a set, N.
        dimension: 1 or 2.
        seed: Another seed gives other sets.
    """

    def __init__(
        self, pattern: str, weights: str, count: int, dimension: int, seed: int
    ) -> None:
        self.count, self._kind, self._dimension = count, weights, dimension
        most = _FEW_SETS if pattern == _SLOW else _MOST_SETS
        self._set_count = min(max(2, _POINTS // count), most)
        rng = np.random.default_rng(seed)
        table = np.ones((self._set_count, count, dimension + 1), np.float32)
        for rows in table:
            x = points(pattern, count, dimension, rng)
            # Their order must not be that of another sampler
            rng.shuffle(x)
            rows[:, :-1] = x
            if weights != "none":
                rows[:, -1] = count * voronoi_weights(x, _BOUNDARIES[weights])
        self._table = mi.Float(np.ascontiguousarray(np.pad(table, _PADS[dimension]).ravel()))
        self._opaque_count, self._opaque_sets = (
            dr.opaque(mi.UInt32, n) for n in (count, self._set_count)
        )
        dr.eval(self._table)

    def draw(
        self, choice: mi.UInt32, shift: mi.Point2f, index: mi.UInt32, active: mi.Bool
    ) -> tuple[Any, mi.Float]:
        """The point ``index`` of a set, and its weight times N.

        Parameters:
            choice: Any number; it decides which set.
            shift: In [0, 1)ᴰ.
            index: Below N.
        """
        row = (choice % self._opaque_sets) * self._opaque_count + index
        if self._dimension == 1:
            entry = dr.gather(mi.Point2f, self._table, row, active)
            u, weight = mi.Point2f(entry.x, 0), entry.y
        else:
            entry = dr.gather(mi.Vector4f, self._table, row, active)
            u, weight = mi.Point2f(entry.x, entry.y), entry.z
        if self._kind != "voronoi":
            u += shift
            u -= dr.floor(u)
        if self._kind == "unbiased":
            u = 1 - dr.abs(2 * u - 1)
        # Rounding must not reach the upper end
        u = dr.minimum(u, dr.one_minus_epsilon(mi.Float))
        return (u if self._dimension == 2 else u.x), weight


_BOUNDARIES = {"voronoi": "clip", "torus": "torus", "unbiased": "torus"}

#: Rows of two or four numbers are read at once.
_PADS = {1: ((0, 0), (0, 0), (0, 0)), 2: ((0, 0), (0, 0), (0, 1))}
