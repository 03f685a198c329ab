"""Point sets in the unit cube, and weights for Monte Carlo sums over them. Neither needs a scene.

>>> from mitsuba_ext.util.pointsets import points, voronoi_weights
>>> x = points("independent", 1024, dimension=2, seed=1)
>>> w = voronoi_weights(x, boundary="torus")
>>> estimate = (w * f(x[:, 0], x[:, 1])).sum()

Source: Guo, PhD thesis, chapter 4 and appendix A. The documentation of :func:`voronoi_weights` says
which weights are unbiased.
"""

from .line import correction, nearest_neighbour_weights, trapezoid_weights, unbiased_weights
from .patterns import PATTERNS, points, shifted, tent
from .strata import piecewise_points, piecewise_weights, stratum_weights
from .voronoi import voronoi_weights

__all__ = [
    "PATTERNS",
    "correction",
    "nearest_neighbour_weights",
    "piecewise_points",
    "piecewise_weights",
    "points",
    "shifted",
    "stratum_weights",
    "tent",
    "trapezoid_weights",
    "unbiased_weights",
    "voronoi_weights",
]
