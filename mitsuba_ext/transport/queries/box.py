"""Boxes around geometry that few rays meet."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class Box:
    """A bounding box. Most rays miss it; if all rays of a packet do, what is in it is skipped."""

    def __init__(self, bounds: mi.ScalarBoundingBox3f) -> None:
        # Covers rounding errors of coordinates on the device
        margin = 1e-5 * max(map(abs, [*bounds.min, *bounds.max]))
        self._low = mi.Point3f(bounds.min) - margin
        self._high = mi.Point3f(bounds.max) + margin
        # Opaque: other boxes share the kernel
        dr.make_opaque(self._low, self._high)

    def is_met(self, ray: mi.Ray3f) -> mi.Bool:
        """Whether there may be a hit before ``ray.maxt``."""
        # A zero component of the direction gives ±∞, and NaN only for an origin in the plane of a
        # side, where the box holds no surface
        inverse = dr.rcp(ray.d)
        a, b = (self._low - ray.o) * inverse, (self._high - ray.o) * inverse
        near, far = dr.max(dr.fmin(a, b)), dr.min(dr.fmax(a, b))
        # The margin is slightly larger than the rounding errors of both distances
        return (near <= far * (1 + 1e-6)) & (far >= 0) & (near <= ray.maxt)
