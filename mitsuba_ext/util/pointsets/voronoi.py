"""Weights of points: the measures of their Voronoi cells.

Source: Guo, PhD thesis, section 4.4.1 (Eq. 4.4). That periodic cells are unbiased is our addition.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import QhullError, Voronoi, cKDTree

from .line import FloatArray, cell_lengths, checked_points

BOUNDARIES = ("clip", "torus")

#: The minimum distance from the border to which points are moved with ``clip``: Qhull must
#: distinguish them from their mirror images.
_BORDER = 1e-7

#: The distance, by dimension, below which points count as equal: Qhull cannot distinguish them.
_SPACING = {2: 1e-10, 3: 1e-7}

#: The maximum errors of the sum of all cells: with only the images near the domain (a missing image
#: causes a larger error), and with all images (close points cause rounding errors).
_NEAR_TOLERANCE, _FULL_TOLERANCE = 1e-9, 1e-5


def voronoi_weights(points: npt.ArrayLike, boundary: str = "torus") -> FloatArray:
    """Measures of the Voronoi cells of points in [0, 1]ᴰ; they add up to one. Points that coincide
    share a cell equally.

    Sums Σ wᵢ f(xᵢ) with these weights are

    - with ``"clip"``: consistent, but biased, because cells are cut off at the border. In one
      dimension, :func:`~mitsuba_ext.util.pointsets.unbiased_weights` corrects this for independent
      uniform points.
    - with ``"torus"``: unbiased in every dimension for independent uniform points, and for *any*
      points after a uniform random shift around the torus
      (:func:`~mitsuba_ext.util.pointsets.shifted`), because all positions are then equally likely.
      If f differs at opposite ends, evaluate it at ``tent(points)`` instead: still unbiased, and
      without the discontinuity at the border.

    Parameters:
        points: Of shape (N,) or (N, D), with D = 1, 2 or 3.
        boundary: ``"clip"``, or ``"torus"`` for a domain whose opposite sides are joined.

    Returns:
        Array of shape (N,).

    Raises:
        ValueError: There are no points, or some are outside the domain; D is too large; the
            boundary is unknown; the cells do not fill the domain, because of rounding.
    """
    x = checked_points("voronoi_weights", points, 2)
    if boundary not in BOUNDARIES:
        raise ValueError(f'voronoi_weights: boundary is "{boundary}", not one of {BOUNDARIES}')
    dimension = 1 if x.ndim == 1 else x.shape[1]
    if dimension > 3:
        raise ValueError(f"voronoi_weights: {dimension} dimensions; at most 3 are supported")
    if boundary == "torus":
        x = x % 1
    if dimension == 1:
        return cell_lengths(x.ravel(), boundary)
    if boundary == "clip":
        x = np.clip(x, _BORDER, 1 - _BORDER)
    places, which = _places(x, boundary)
    return (_measures(places, boundary) / np.bincount(which))[which]


def _places(x: FloatArray, boundary: str) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """The distinct positions of the points, and for each point the index of its position."""
    places, which = np.unique(x, axis=0, return_inverse=True)
    tree = cKDTree(places, boxsize=1.0 if boundary == "torus" else None)
    pairs = tree.query_pairs(_SPACING[x.shape[1]], output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    _count, group = connected_components(graph, directed=False)
    _group, first = np.unique(group, return_index=True)
    return places[first], group[which.ravel()]


def _measures(x: FloatArray, boundary: str) -> FloatArray:
    """Areas or volumes of the cells of points that do not coincide; they add up to one."""
    near = 3 * len(x) ** (-1 / x.shape[1])
    for margin, tolerance in ((near, _NEAR_TOLERANCE), (np.inf, _FULL_TOLERANCE)):
        try:
            measures = _cell_measures(x, _images(x, boundary, margin))
        except QhullError:
            # For example, all points are on a line, and images off the line are beyond the margin
            continue
        # If a needed image is missing, cells are too large, and so is their sum
        if abs(measures.sum() - 1) < tolerance:
            return measures / measures.sum()
    raise ValueError("voronoi_weights: the cells do not fill the domain; are points very close?")


def _images(x: FloatArray, boundary: str, margin: float) -> FloatArray:
    """Copies of points around the domain that are not farther from it than ``margin``: mirrored at
    each face, or shifted by whole periods."""
    dimension = x.shape[1]
    if boundary == "clip":
        # A face is equally far from a point and its mirror image, so the point's cell ends there
        unit = np.eye(dimension)
        copies = [2 * side * e + x * (1 - 2 * e) for e in unit for side in (0, 1)]
    else:
        copies = [x + o for o in itertools.product((-1, 0, 1), repeat=dimension) if any(o)]
    images = np.concatenate(copies)
    return images[((images >= -margin) & (images <= 1 + margin)).all(axis=1)]


def _cell_measures(x: FloatArray, images: FloatArray) -> FloatArray:
    """Areas or volumes of the cells of ``x`` among ``images``: infinite for unbounded cells, 0 for
    points that Qhull merges with a neighbour."""
    count, dimension = x.shape
    diagram = Voronoi(np.concatenate([x, images]))
    pair = diagram.ridge_points
    concerns = (pair < count).any(axis=1)
    pair, index = pair[concerns], np.flatnonzero(concerns)
    ridges = [diagram.ridge_vertices[i] for i in index]
    lengths = np.fromiter(map(len, ridges), int, len(ridges))
    corner = np.fromiter(itertools.chain.from_iterable(ridges), int, lengths.sum())
    first = np.cumsum(lengths) - lengths
    v = diagram.vertices[corner]
    if dimension == 2:
        size = np.linalg.norm(v[first + 1] - v[first], axis=1)
    else:
        # A fan of triangles around the first corner
        following = np.roll(np.arange(len(corner)), -1)
        following[first + lengths - 1] = first
        origin = np.repeat(v[first], lengths, axis=0)
        normal = np.cross(v - origin, v[following] - origin)
        size = np.linalg.norm(np.add.reduceat(normal, first), axis=1) / 2
    size[np.minimum.reduceat(corner, first) < 0] = np.inf
    # Each face is the base of two pyramids, whose apexes are the two points
    heights = np.linalg.norm(diagram.points[pair[:, 0]] - diagram.points[pair[:, 1]], axis=1) / 2
    measure = np.repeat(size * heights / dimension, 2)
    return np.bincount(pair.ravel(), measure, minlength=count)[:count]
