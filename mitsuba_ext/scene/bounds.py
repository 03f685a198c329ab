"""Bounding boxes of shapes and scenes.

Mitsuba 3.9.1 merges meshes of one material when it loads a scene. The boxes of the merged mesh and
of the scene then do not contain the merged rectangles (``Mesh::merge`` reads a member that
rectangles do not fill). The boxes here are computed from the vertices.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np


def scene_bounds(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """The box of all shapes; not valid if there are none."""
    box = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        box.expand(shape_bounds(shape))
    return box


def shape_bounds(shape: mi.Shape) -> mi.ScalarBoundingBox3f:
    """The box of one shape."""
    if not shape.is_mesh() or shape.vertex_count() == 0:
        return shape.bbox()
    positions = np.array(shape.vertex_positions_buffer())
    # Each coordinate separately: NumPy reduces along an axis of length three 15 times as slowly
    axes = [positions[axis::3] for axis in range(3)]
    return mi.ScalarBoundingBox3f([x.min() for x in axes], [x.max() for x in axes])
