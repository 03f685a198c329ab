"""How rays intersect the scene: a decision of the walk. This one is the same as in ``path``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .ray_starts import RayStarts


class SceneQuery:
    """How rays intersect the scene.

    Parameters (and attributes):
        starts: Where rays that leave a surface start; by default, the same as in Mitsuba.
    """

    def __init__(self, starts: RayStarts = RayStarts()) -> None:  # noqa: B008  (never modified)
        self.starts = starts

    def closest(
        self, scene: mi.Scene, ray: mi.Ray3f, coherent: bool, active: mi.Bool
    ) -> mi.PreliminaryIntersection3f:
        """The closest intersection. ``coherent`` is a hint that neighbouring rays are alike."""
        reorder = not coherent and dr.flag(dr.JitFlag.LoopRecord)
        return scene.ray_intersect_preliminary(
            ray, coherent=coherent, reorder=reorder, active=active
        )

    def interaction(
        self, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f
    ) -> mi.SurfaceInteraction3f:
        """The full surface interaction of an intersection that :meth:`closest` found."""
        return pi.compute_surface_interaction(ray, mi.RayFlags.All)

    def emitter(self, si: mi.SurfaceInteraction3f, emitter: mi.EmitterPtr) -> mi.EmitterPtr:
        """The light of ``scene.emitters()`` at ``si``; ``emitter`` is Mitsuba's answer."""
        return emitter

    def occluded(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> mi.Bool:
        """Whether the light sample ``ds`` is occluded from ``si``."""
        ray = self.shadow_ray(scene, si, ds)
        if self.starts.exact:
            # Mitsuba tests in single precision whether a sphere occludes: the square of the
            # distance is rounded. Intersections with spheres are computed in double precision
            return self.closest(scene, ray, coherent=False, active=active).is_valid()
        return scene.ray_test(ray, active=active)

    def shadow_ray(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f
    ) -> mi.Ray3f:
        """The ray from ``si`` to the light sample ``ds``."""
        ray = self.starts.towards(si, ds.p, ds.n)
        if any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters()):
            # Mitsuba puts ds.p outside of the bounds of the scene, which are wrong where it has
            # merged rectangles (``bounds.py``): its shadow rays may end before a wall
            is_infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
            ray.maxt = dr.select(is_infinite, dr.largest(mi.Float), ray.maxt)
        return ray
