"""Sampling disks by solid angle."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..solid_angles.disk import EllipticalCone, elliptical_cone
from .surface import Surface, SurfacePoint

#: The tolerance for equally long, perpendicular axes, as a fraction of their squared length.
_TOLERANCE = 1e-4


class DiskSurface(Surface):
    """A round disk, sampled by its solid angle."""

    def __init__(self, shape: mi.Shape) -> None:
        super().__init__(shape)
        self._to_world = mi.traverse(shape)["to_world"]
        self._centre = self._to_world @ mi.Point3f(0)
        self._radius = dr.norm(self._to_world @ mi.Vector3f(1, 0, 0))

    def _seen_from(self, p: mi.Point3f, normal: mi.Normal3f) -> EllipticalCone:
        return elliptical_cone(self._centre - p, mi.Vector3f(normal), self._radius)

    def _normal(self) -> mi.Normal3f:
        return self.shape.sample_position(0, mi.Point2f(0.5)).n

    def sample(self, it, sample, active):
        p = it.p
        normal = self._normal()
        cone = self._seen_from(p, normal)
        offset = cone.sample(sample)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(offset))
        si.p, si.n = self._centre + offset, normal
        si.sh_frame = mi.Frame3f(normal)
        local = self._to_world.inverse() @ si.p
        angle = dr.atan2(local.y, local.x) * dr.inv_two_pi
        angle = dr.select(angle < 0, angle + 1, angle)
        si.uv = mi.Point2f(dr.minimum(dr.hypot(local.x, local.y), 1), angle)
        return SurfacePoint(si, cone.pdf(si.p - p))

    def pdf(self, it, ds):
        p = it.p
        return self._seen_from(p, self._normal()).pdf(ds.p - p)


def is_round(shape: mi.Shape) -> bool:
    """Whether a disk is a circle rather than an ellipse."""
    matrix = mi.traverse(shape)["to_world"].matrix
    # Element by element, because a matrix cannot be read while Dr.Jit records a call
    x, y = (np.array([matrix[i, j].numpy()[0] for i in range(3)]) for j in range(2))
    square = x @ x
    return abs(y @ y - square) < _TOLERANCE * square and abs(x @ y) < _TOLERANCE * square
