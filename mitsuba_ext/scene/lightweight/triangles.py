"""Intersects rays with triangles; no ray passes between two that share an edge or a corner.

Corners are projected along the ray. The signs of three areas tell whether the projected triangle
contains the ray. Triangles that share an edge compute its area from the same two points of the
plane, with opposite signs, however these are rounded. The rounded projections therefore cover the
plane without gaps, as in [1].

[1] Woop, Benthin, Wald. Watertight Ray/Triangle Intersection. Journal of Computer Graphics
Techniques 2(1), 2013.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi


class Projection:
    """The view along a ray.

    Parameters:
        ray: The ray. Its direction need not be normalized.
    """

    def __init__(self, ray: mi.Ray3f) -> None:
        self._o = ray.o
        self._x, self._y = mi.coordinate_system(dr.normalize(ray.d))
        self._z = ray.d / dr.squared_norm(ray.d)

    def intersect(
        self, maxt: mi.Float, corners: Sequence[mi.Point3f]
    ) -> tuple[mi.Bool, mi.Float, mi.Point2f]:
        """Whether the ray hits a triangle before ``maxt``; if so, at which distance, and the
        barycentric coordinates of the second and third corner."""
        offsets = [corner - self._o for corner in corners]
        a, b, c = (mi.Point2f(_dot(p, self._x), _dot(p, self._y)) for p in offsets)
        area_a, area_b, area_c = _area(b, c), _area(c, a), _area(a, b)
        is_inside = (dr.minimum(dr.minimum(area_a, area_b), area_c) >= 0) | (
            dr.maximum(dr.maximum(area_a, area_b), area_c) <= 0
        )
        # Zero for a triangle that is seen edge on: it is not hit, because the distance is NaN
        scale = dr.rcp(area_a + area_b + area_c)
        uv = mi.Point2f(area_b, area_c) * scale
        z_a, z_b, z_c = (_dot(p, self._z) for p in offsets)
        t = z_a * (area_a * scale) + z_b * uv.x + z_c * uv.y
        return is_inside & (t >= 0) & (t < maxt), t, uv


def _dot(p: mi.Vector3f, q: mi.Vector3f) -> mi.Float:
    # Explicitly fused, so that all triangles round the projection of a corner alike
    return dr.fma(p.x, q.x, dr.fma(p.y, q.y, p.z * q.z))


def _area(p: mi.Point2f, q: mi.Point2f) -> mi.Float:
    """Four times the area between the origin and an edge. If the ends of the edge are swapped, only
    its sign changes: each rounded product has its counterpart."""
    a, b = p.x * q.y, p.y * q.x
    return dr.fma(p.x, q.y, -b) - dr.fma(p.y, q.x, -a)
