"""Placeholder meshes for geometry that Mitsuba does not intersect."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy


def span(mesh: mi.Mesh, low: np.ndarray, high: np.ndarray) -> None:
    """Gives ``mesh``, which has three vertices and two faces, a box that becomes part of the
    scene's box. Its triangles have no area, so no ray can hit them."""
    parameters = mi.traverse(mesh)
    # Rounded outwards
    low = np.nextafter(np.asarray(low).astype(np.float32), np.float32(-np.inf))
    high = np.nextafter(np.asarray(high).astype(np.float32), np.float32(np.inf))
    parameters["vertex_positions"] = from_numpy(mi.Float, np.concatenate([low, high, high]))
    parameters["faces"] = mi.UInt32([0, 0, 1, 1, 1, 2])
    parameters.update()
