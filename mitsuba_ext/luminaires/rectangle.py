"""Rectangles, and the parallelograms that sheared ones are."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..solid_angles.spherical_polygon import SphericalPolygon, spherical_polygon
from .surface import Surface, SurfacePoint


class RectangleSurface(Surface):
    """A rectangle, sampled by its solid angle."""

    def __init__(self, shape: mi.Shape) -> None:
        super().__init__(shape)
        to_world = mi.traverse(shape)["to_world"]
        self._corner = to_world @ mi.Point3f(-1, -1, 0)
        self._edges = [to_world @ mi.Vector3f(2, 0, 0), to_world @ mi.Vector3f(0, 2, 0)]

    def _seen_from(self, p: mi.Point3f) -> SphericalPolygon:
        x, y = self._edges
        corner = self._corner - p
        corners = [corner, corner + x, corner + x + y, corner + y]
        return spherical_polygon(corners, [x, y, -x, -y])

    def sample(self, p, sample, active):
        polygon = self._seen_from(p)
        index, a, b = polygon.sample(sample)
        # The corners of the two triangles are 1 and 2, and 2 and 3
        is_first = index == 0
        uv = mi.Point2f(dr.select(is_first, a + b, a), dr.select(is_first, b, a + b))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.p = self._corner + uv.x * self._edges[0] + uv.y * self._edges[1]
        si.uv = uv
        si.n = self.shape.sample_position(0, mi.Point2f(0.5), active).n
        si.sh_frame = mi.Frame3f(si.n)
        return SurfacePoint(si, _reciprocal(polygon.solid_angle))

    def pdf(self, p, ds):
        return _reciprocal(self._seen_from(p).solid_angle)


def _reciprocal(solid_angle: mi.Float) -> mi.Float:
    return dr.select(solid_angle > 0, dr.rcp(dr.maximum(solid_angle, 1e-37)), 0)
