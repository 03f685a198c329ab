"""Weights of points in an interval.

Source: Guo, PhD thesis, section 4.4 (Eqs. 4.4 to 4.8); for trapezoid and nearest-neighbour weights,
Yakowitz, Krimmel and Szidarovszky, Weighted Monte Carlo integration, SIAM J. Numer. Anal. 15(6),
1978.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

FloatArray = npt.NDArray[np.float64]


def checked_points(function: str, x: npt.ArrayLike, most_axes: int = 1) -> FloatArray:
    """The points as an array of shape (N,), or with two axes also (N, D).

    Raises:
        ValueError: The shape is different, there are no points, or some are outside the unit
            cube.
    """
    x = np.asarray(x, float)
    if not 1 <= x.ndim <= most_axes or x.size == 0:
        shapes = "(N,) or (N, D)" if most_axes == 2 else "(N,)"
        raise ValueError(f"{function}: points of shape {shapes} expected, not {x.shape}")
    # This form of the condition also rejects NaN
    if not (x.min() >= 0 and x.max() <= 1):
        raise ValueError(f"{function}: there are points outside the unit cube, or NaN")
    return x


def cell_lengths(x: npt.ArrayLike, boundary: str) -> FloatArray:
    """The length of each point's Voronoi cell in [0, 1]. Equal points share a cell equally.

    Parameters:
        x: Points, of shape (N,), in any order.
        boundary: ``"clip"`` (the cells end at 0 and 1) or ``"torus"`` (0 and 1 are joined).
    """
    x, which, counts = np.unique(np.asarray(x, float), return_inverse=True, return_counts=True)
    middle = (x[1:] + x[:-1]) / 2
    if boundary == "clip":
        ends = [0.0], [1.0]
    else:
        # On the torus, the left neighbour of the first point is the last one, moved by −1
        seam = (x[0] + x[-1] - 1) / 2
        ends = [seam], [seam + 1]
    edges = np.concatenate([ends[0], middle, ends[1]])
    return (np.diff(edges) / counts)[which]


def correction(x: npt.ArrayLike, count: int) -> FloatArray:
    """g(x): the expected length of the clipped cell of a point at ``x`` among ``count`` independent
    uniform points, relative to 1 / ``count`` (Guo, Eq. 4.7). At both ends it is 1/2."""
    x = np.asarray(x, float)
    y = 1 - x
    right, left = x ** (count - 1), y ** (count - 1)
    # With y = 1 − x, because N − (N + 1) x would lose digits near x = 1
    return (((count + 1) * y - 1) * right + ((count + 1) * x - 1) * left + 2) / 2


def unbiased_weights(x: npt.ArrayLike) -> FloatArray:
    """Lengths of the clipped cells divided by :func:`correction`, which makes sums unbiased for
    independent uniform points (Guo, Eq. 4.8). The weights do not add up to one, so even the
    estimate of a constant has variance."""
    x = checked_points("unbiased_weights", x)
    return cell_lengths(x, "clip") / correction(x, len(x))


def trapezoid_weights(x: npt.ArrayLike) -> tuple[FloatArray, float, float]:
    """The trapezoidal rule through 0, the points, and 1 (Yakowitz et al.).

    Returns:
        The weights of the points, the weight of f(0), and the weight of f(1).
    """
    x = checked_points("trapezoid_weights", x)
    low, high = float(x.min()), float(x.max())
    weights = cell_lengths(x, "clip")
    for end, distance in ((low, low), (high, 1 - high)):
        at_end = x == end
        weights[at_end] -= distance / 2 / at_end.sum()
    return weights, low / 2, (1 - high) / 2


def nearest_neighbour_weights(x: npt.ArrayLike, tests: npt.ArrayLike) -> FloatArray:
    """For each point, the fraction of test points that are nearest to it (Yakowitz et al.). This
    estimates the measure of its clipped cell in any dimension, without a Voronoi diagram.

    Parameters:
        x, tests: Points of shape (N,) or (N, D), and (M,) or (M, D).
    """
    x, tests = (checked_points("nearest_neighbour_weights", a, 2) for a in (x, tests))
    x, tests = (a.reshape(len(a), -1) for a in (x, tests))
    if x.shape[1] != tests.shape[1]:
        shapes = f"{x.shape} and {tests.shape}"
        raise ValueError(f"nearest_neighbour_weights: points and tests have shapes {shapes}")
    _distance, nearest = cKDTree(x).query(tests)
    return np.bincount(nearest, minlength=len(x)) / len(tests)
