"""Weights within strata, and points of piecewise constant densities.

Source: Guo, PhD thesis, section 4.4.4.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from .line import FloatArray, checked_points, unbiased_weights

#: A function that computes weights of points in [0, 1].
Weigher = Callable[[FloatArray], FloatArray]


def stratum_weights(
    x: npt.ArrayLike, edges: npt.ArrayLike, weigher: Weigher = unbiased_weights
) -> FloatArray:
    """Weights that are computed in each stratum separately, and scaled by its length.

    Parameters:
        x: Points in [0, 1], of shape (N,).
        edges: Limits of the strata, ascending from 0 to 1; each stratum has one point or more.
        weigher: Weights of points of a single stratum, scaled to [0, 1].

    Raises:
        ValueError: A stratum has no point, so its part of the integral would be lost; a point is
            outside [0, 1]; or the edges do not ascend from 0 to 1.
    """
    x, edges = checked_points("stratum_weights", x), _checked_edges("stratum_weights", edges)
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
        probabilities: Probabilities of the pieces, of shape (K,), with sum 1.

    Raises:
        ValueError: Points, edges or probabilities are not as described.
    """
    u = checked_points("piecewise_points", u)
    edges, probabilities = _checked_pieces("piecewise_points", edges, probabilities)
    return np.interp(u, np.cumsum([0, *probabilities]), edges)


def piecewise_weights(
    x: npt.ArrayLike,
    edges: npt.ArrayLike,
    probabilities: npt.ArrayLike,
    weigher: Weigher = unbiased_weights,
) -> FloatArray:
    """Weights of independent points of a piecewise constant density, computed in each piece
    separately. A piece may have no point by chance. Its weights are therefore divided by the
    probability that it has at least one: sums are unbiased if sums by ``weigher`` are.

    Parameters:
        x: Points in [0, 1], of shape (N,).
        edges, probabilities: As in :func:`piecewise_points`.
        weigher: Weights of points of a single piece, scaled to [0, 1].

    Raises:
        ValueError: Points, edges or probabilities are not as described.
    """
    x = checked_points("piecewise_weights", x)
    edges, probabilities = _checked_pieces("piecewise_weights", edges, probabilities)
    weights, counts = _within(x, edges, weigher)
    is_met = -np.expm1(len(x) * np.log1p(-np.minimum(probabilities, 1 - 1e-16)))
    return weights / is_met[_stratum(x, edges)]


def _checked_edges(function: str, edges: npt.ArrayLike) -> FloatArray:
    edges = np.asarray(edges, float)
    ascend = edges.ndim == 1 and len(edges) > 1 and (np.diff(edges) > 0).all()
    if not (ascend and edges[0] == 0 and edges[-1] == 1):
        raise ValueError(f"{function}: edges are {edges}, not ascending from 0 to 1")
    return edges


def _checked_pieces(
    function: str, edges: npt.ArrayLike, probabilities: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    edges, p = _checked_edges(function, edges), np.asarray(probabilities, float)
    if p.shape != (len(edges) - 1,) or not ((p >= 0).all() and abs(p.sum() - 1) < 1e-9):
        raise ValueError(f"{function}: probabilities are {p}, not {len(edges) - 1} with sum 1")
    return edges, p


def _within(
    x: FloatArray, edges: FloatArray, weigher: Weigher
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Weights of the points, and the number of points in each stratum."""
    stratum, weights = _stratum(x, edges), np.empty(len(x))
    order = np.argsort(stratum, kind="stable")
    counts = np.bincount(stratum, minlength=len(edges) - 1)
    for index, chosen in enumerate(np.split(order, np.cumsum(counts)[:-1])):
        low, high = edges[index : index + 2]
        if len(chosen):
            weights[chosen] = (high - low) * weigher((x[chosen] - low) / (high - low))
    return weights, counts


def _stratum(x: FloatArray, edges: FloatArray) -> npt.NDArray[np.int64]:
    # The point 1 belongs to the last stratum
    return np.minimum(np.searchsorted(edges, x, side="right") - 1, len(edges) - 2)
