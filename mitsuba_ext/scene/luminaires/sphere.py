"""Sampling spheres by solid angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..solid_angles.cone import Cone, cone
from .surface import Surface, SurfacePoint, per_solid_angle

#: The fraction of the radius by which points on the surface of a sphere that shines inwards may lie
#: outside it because of rounding.
_ROUNDING = 1e-5


class SphereSurface(Surface):
    """A sphere. From outside it is sampled by the solid angle of its cone; from inside, where it
    surrounds the point, by area. (For a point on the surface, the density of directions is then
    proportional to the cosine.)"""

    def __init__(self, shape: mi.Shape) -> None:
        super().__init__(shape)
        to_world = mi.traverse(shape)["to_world"]
        self._centre = to_world @ mi.Point3f(0)
        self._radius = dr.norm(to_world @ mi.Vector3f(1, 0, 0))
        self._shines_inwards = shape.has_flipped_normals()

    def _is_inside(self, p: mi.Point3f) -> mi.Bool:
        if not self._shines_inwards:
            # The inner side does not emit
            return mi.Bool(False)
        return dr.squared_norm(p - self._centre) < dr.square((1 + _ROUNDING) * self._radius)

    def _cone(self, p: mi.Point3f) -> Cone:
        return cone(self._centre - p, self._radius)

    def sample(self, it, sample, active):
        p = it.p
        seen = self._cone(p)
        normal, pdf = seen.sample(sample), dr.rcp(seen.solid_angle)
        if self._shines_inwards:
            is_inside = self._is_inside(p)
            normal = dr.select(is_inside, mi.warp.square_to_uniform_sphere(sample), normal)
            to_light = self._centre + self._radius * normal - p
            from_inside = per_solid_angle(dr.rcp(self.area()), to_light, normal)
            pdf = dr.select(is_inside, from_inside, pdf)
        return SurfacePoint(self._point(normal, active), pdf)

    def pdf(self, it, ds):
        p = it.p
        pdf = dr.rcp(self._cone(p).solid_angle)
        if self._shines_inwards:
            from_inside = per_solid_angle(dr.rcp(self.area()), ds.d * ds.dist, ds.n)
            pdf = dr.select(self._is_inside(p), from_inside, pdf)
        return pdf

    def sample_area(self, sample, active):
        # Not with the shape's method, which does not rotate normals with the sphere
        normal = mi.warp.square_to_uniform_sphere(sample)
        return SurfacePoint(self._point(normal, active), dr.rcp(self.area()))

    def _point(self, normal: mi.Vector3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        p = self._centre + self._radius * normal
        return self.found(p, mi.Point2f(0), mi.UInt32(0), active)
