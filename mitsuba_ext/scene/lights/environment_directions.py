"""Directions towards an environment emitter."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..bounds import scene_bounds

#: The minimum sine of the polar angle: at the poles, densities would be infinite.
MIN_SINE = 1e-7


class EnvironmentDirections:
    """Direction samples towards an environment, and coordinates of its directions.

    Parameters:
        scene: The scene with the environment emitter.

    Attributes:
        emitter (mi.Emitter), pointer (mi.EmitterPtr): The emitter.
        is_map (bool): Whether the emitter is an ``envmap``, whose emission is an image.
        center (mi.Point3f): Centre of the scene.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._scene = scene  # kept alive, because its emitter must be
        self.emitter = scene.environment()
        self.pointer = mi.EmitterPtr(self.emitter)
        self.is_map = self.emitter.class_name() == "EnvironmentMapEmitter"
        bbox = scene_bounds(scene)
        sphere = bbox.bounding_sphere() if bbox.valid() else mi.ScalarBoundingSphere3f(0.0, 1.0)
        # Enlarged so that samples lie behind all shapes even after rounding
        self.center, self._radius = mi.Point3f(sphere.center), mi.Float(1.001 * sphere.radius)
        self._to_world = mi.Transform4f(self.emitter.world_transform())
        self._to_local = self._to_world.inverse()
        dr.make_opaque(self.center, self._radius, self._to_world, self._to_local)

    def sample(self, ref: mi.Interaction3f, d: mi.Vector3f) -> mi.DirectionSample3f:
        """The direction sample for ``d`` (in world space), without ``uv`` and density."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = d
        ds.dist = 2 * dr.maximum(self._radius, dr.norm(ref.p - self.center))
        ds.p = ref.p + ds.d * ds.dist
        ds.n = -ds.d
        ds.time = ref.time
        ds.emitter = self.pointer
        return ds

    def radiance(self, ref: mi.Interaction3f, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """The radiance from the direction ``d``."""
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi, si.wavelengths, si.time = -d, ref.wavelengths, ref.time
        return self.emitter.eval(si, active)

    def direction(self, uv: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """The direction (in world space) of a point of the unit square, as Mitsuba's ``envmap``
        maps it, and the sine of its polar angle."""
        sin_theta, cos_theta = dr.sincos(uv.y * dr.pi)
        sin_phi, cos_phi = dr.sincos(uv.x * dr.two_pi)
        sin_theta = dr.maximum(sin_theta, MIN_SINE)
        d = mi.Vector3f(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta)
        return self._to_world @ d, sin_theta

    def uv(self, d: mi.Vector3f) -> tuple[mi.Point2f, mi.Float]:
        """The inverse of :meth:`direction`: a point, whose first coordinate is known only up to an
        integer, and the sine of the polar angle."""
        v = self._to_local @ d
        u = dr.atan2(v.x, -v.z) * dr.inv_two_pi
        # Accurate near the poles, where the cosine hardly changes
        sin_theta = dr.maximum(dr.sqrt(dr.square(v.x) + dr.square(v.z)), MIN_SINE)
        return mi.Point2f(u, dr.atan2(sin_theta, v.y) * dr.inv_pi), sin_theta
