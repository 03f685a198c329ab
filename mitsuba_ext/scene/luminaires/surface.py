"""Sampling points on the shape of an area light."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class SurfacePoint:
    """A point of a light.

    Attributes:
        si: The interaction at the point; ``wi`` is not set.
        pdf: The density with which the point was sampled, per solid angle or per area.
    """

    si: mi.SurfaceInteraction3f
    pdf: mi.Float


class Surface:
    """Samples points of a shape by area. Subclasses for shapes whose solid angle is known override
    :meth:`sample` and :meth:`pdf`.

    Parameters:
        shape: The shape of the light.
    """

    def __init__(self, shape: mi.Shape) -> None:
        self.shape = shape

    def sample(self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        """Samples a point for next event estimation at ``it``, and its density per solid angle
        there."""
        point = self.sample_area(sample, active)
        point.pdf = per_solid_angle(point.pdf, point.si.p - it.p, point.si.n)
        return point

    def pdf(self, it: mi.Interaction3f, ds: mi.DirectionSample3f) -> mi.Float:
        """The density, per solid angle, of the point of ``ds`` under :meth:`sample` at ``it``."""
        return per_solid_angle(dr.rcp(self.area()), ds.d * ds.dist, ds.n)

    def sample_area(self, sample: mi.Point2f, active: mi.Bool) -> SurfacePoint:
        """Samples a uniformly distributed point of the surface, and its density per area."""
        ps = self.shape.sample_position(0, sample, active)
        si = mi.SurfaceInteraction3f(ps, dr.zeros(mi.SurfaceInteraction3f).wavelengths)
        return SurfacePoint(si, ps.pdf)

    def area(self) -> mi.Float:
        return self.shape.surface_area()

    def found(
        self, p: mi.Point3f, prim_uv: mi.Point2f, prim_index: mi.UInt32, active: mi.Bool
    ) -> mi.SurfaceInteraction3f:
        """The interaction of a ray that hits the surface at the point ``p``."""
        pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(p))
        pi.prim_uv, pi.prim_index = prim_uv, prim_index
        pi.t, pi.valid = dr.select(active, mi.Float(0), dr.inf), mi.Bool(active)
        ray = dr.zeros(mi.Ray3f, dr.width(p))
        # Only ``wi`` depends on the direction, and callers replace it
        ray.o, ray.d = p, mi.Vector3f(0, 0, 1)
        si = self.shape.compute_surface_interaction(ray, pi, mi.RayFlags.All, active)
        si.sh_frame = mi.Frame3f(si.sh_frame.n)
        si.shape = mi.ShapePtr(self.shape)
        return si


def per_solid_angle(pdf: mi.Float, to_light: mi.Vector3f, n: mi.Normal3f) -> mi.Float:
    """Converts a density per area to a density per solid angle; 0 if the light is seen edge on."""
    squared = dr.squared_norm(to_light)
    cosine = dr.abs(dr.dot(to_light, n)) * dr.rsqrt(dr.maximum(squared, 1e-37))
    return dr.select(cosine > 0, pdf * squared / dr.maximum(cosine, 1e-37), 0)
