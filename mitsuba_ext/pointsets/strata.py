"""Weights within strata, and points of piecewise constant densities.

Source: Guo, PhD thesis, section 4.4.4.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from .line import FloatArray, cell_lengths, unbiased_weights

#: What makes weights of points in [0, 1].
Weigher = Callable[[FloatArray], FloatArray]


def stratum_weights(
    x: npt.ArrayLike, edges: npt.ArrayLike, weigher: Weigher = unbiased_weights
) -> FloatArray:
    """Weights of points that are weighed stratum by stratum, as if each were all there is.

    Parameters:
        x: Points in [0, 1], of shape (N,).
        edges: Limits of the strata, ascending from 0 to 1; each of them has one point or more.
        weigher: Weights of points of a single stratum, scaled to [0, 1].

    Raises:
        ValueError: A stratum has no point: its part of the integral would be lost.
    """
    x, edges = np.asarray(x, float), np.asarray(edges, float)
    weights, counts = _within(x, edges, weigher)
    if (counts == 0).any():
        raise ValueError(f"stratum_weights: no point in {np.sum(counts == 0)} of the strata")
    return weights


def piecewise_points(
    u: npt.ArrayLike, edges: npt.ArrayLike, probabilities: npt.ArrayLike
) -> FloatArray:
    """Moves uniform points of [0, 1) to a density that is constant between edges.

    Parameters:
        u: Points of shape (N,).
        edges: Limits of the K pieces, ascending from 0 to 1.
        probabilities: Of the pieces, of shape (K,), with sum 1.
    """
    return np.interp(np.asarray(u, float), np.cumsum([0, *np.asarray(probabilities)]), edges)


def piecewise_weights(
    x: npt.ArrayLike,
    edges: npt.ArrayLike,
    probabilities: npt.ArrayLike,
    weigher: Weigher = unbiased_weights,
) -> FloatArray:
    """Weights of independent points of a piecewise constant density: they are weighed piece by
    piece. How many a piece has is chance; that it may have none is made up for by those times when
    it has one, so that sums remain unbiased if they are so with ``weigher``.

    Parameters:
        x: Points in [0, 1], of shape (N,).
        edges, probabilities: As in :func:`piecewise_points`.
        weigher: Weights of points of a single piece, scaled to [0, 1].
    """
    x, edges = np.asarray(x, float), np.asarray(edges, float)
    weights, counts = _within(x, edges, weigher)
    is_met = -np.expm1(len(x) * np.log1p(-np.minimum(probabilities, 1 - 1e-16)))
    return weights / is_met[_stratum(x, edges)]


def cell_weigher(boundary: str) -> Weigher:
    """Plain cells of points, to weigh strata with."""
    return functools.partial(cell_lengths, boundary=boundary)


def _within(
    x: FloatArray, edges: FloatArray, weigher: Weigher
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Weights of the points, and how many there are in each stratum."""
    stratum, weights = _stratum(x, edges), np.empty(len(x))
    order = np.argsort(stratum, kind="stable")
    counts = np.bincount(stratum, minlength=len(edges) - 1)
    for index, chosen in enumerate(np.split(order, np.cumsum(counts)[:-1])):
        low, high = edges[index : index + 2]
        if len(chosen):
            local = np.clip((x[chosen] - low) / (high - low), 0, 1)
            weights[chosen] = (high - low) * weigher(local)
    return weights, counts


def _stratum(x: FloatArray, edges: FloatArray) -> npt.NDArray[np.int64]:
    return np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
