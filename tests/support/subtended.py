"""Solid angles in double precision, for comparison: of parts of rectangles, triangles, disks and
spheres. A part is a cell of 6 × 6; every function returns the solid angle of all cells as seen from
the origin, and the cell in which a point of the shape lies."""

from __future__ import annotations

import numpy as np

CELLS = 6


def triangle_solid_angle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The solid angles of triangles with these corners, [..., 3], as seen from the origin (Van
    Oosterom and Strackee 1983)."""
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    volume = np.abs((a * np.cross(b - a, c - a)).sum(-1))
    ab, bc, ac = ((u * v).sum(-1) for u, v in ((a, b), (b, c), (a, c)))
    return 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ac * lb)


def parallelogram_cells(corner: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The solid angles of the cells of a parallelogram, row by row."""
    j, i = np.divmod(np.arange(CELLS * CELLS), CELLS)
    a = corner + (i[:, None] * x + j[:, None] * y) / CELLS
    b, c, d = a + x / CELLS, a + (x + y) / CELLS, a + y / CELLS
    return triangle_solid_angle(a, b, c) + triangle_solid_angle(a, c, d)


def cell_of(uv: np.ndarray) -> np.ndarray:
    """The cell of points of the unit square, [..., 2]."""
    i = np.clip((uv * CELLS).astype(int), 0, CELLS - 1)
    return i[..., 1] * CELLS + i[..., 0]


def disk_cells(x: float, h: float) -> np.ndarray:
    """The solid angles of rings (rows) of the unit disk, each divided by angle, as seen from the
    height ``h`` above the point (x, 0)."""
    few, weights = np.polynomial.legendre.leggauss(8)
    pieces = 500
    nodes = ((np.arange(pieces)[:, None] + 0.5 + 0.5 * few) / pieces).ravel()
    weights = np.tile(weights, pieces) / (2 * pieces)
    φ = (np.arange(CELLS)[:, None] + nodes) * (2 * np.pi / CELLS)
    a = x * np.cos(φ)
    q_2 = (x * np.sin(φ)) ** 2 + h**2

    def integral(r: np.ndarray) -> np.ndarray:
        """The integral of h r / distance³ over the radius."""
        distance = np.sqrt((r - a) ** 2 + q_2)
        return h * (a * (r - a) / (q_2 * distance) - 1 / distance)

    radii = np.arange(CELLS + 1) / CELLS
    rings = [integral(r1) - integral(r0) for r0, r1 in zip(radii[:-1], radii[1:])]
    return np.stack([(ring * weights).sum(-1) * 2 * np.pi / CELLS for ring in rings]).ravel()


def cone_cells(distance: float) -> np.ndarray:
    """The solid angles of rings of the cone of the unit sphere: all equal."""
    gap = (distance - 1) * (distance + 1)
    depth = 1 / distance**2 / (1 + np.sqrt(gap) / distance)
    return np.full(CELLS * CELLS, 2 * np.pi * depth / CELLS**2)
