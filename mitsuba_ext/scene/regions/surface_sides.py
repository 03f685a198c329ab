"""The region in which paths scatter, and the normals of its surfaces on the lit side."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

#: The maximum fraction of vertices outside the region, on either side of each axis.
_MAX_OUTSIDE = 2e-3

#: The margin of the region on each side, in units of its size.
_MARGIN = 0.02


def region(p: mi.Point3f) -> mi.ScalarBoundingBox3f:
    """A box that holds nearly all points. A few distant ones are left out because they would make
    the voxels of the box coarse."""
    points = p.numpy()
    low, high = np.quantile(points, [_MAX_OUTSIDE, 1 - _MAX_OUTSIDE], axis=1)
    # A flat region needs some depth, and distant coordinates are rounded
    size = max((high - low).max(), 1e-4 * np.abs(points).max(), 1e-30)
    margin = _MARGIN * (high - low) + 1e-3 * size
    return mi.ScalarBoundingBox3f(low - margin, high + margin)


def lit_normal(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """The geometric normal on the side from which a surface is seen."""
    return dr.select(dr.dot(si.n, si.to_world(si.wi)) < 0, -si.n, si.n)
