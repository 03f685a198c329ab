"""How rays start and intersect the scene: a decision of the walk. With the defaults, it is the same
as in ``path``.

Rays that leave a surface start at an offset, so that they do not hit it again. Mitsuba's offset is
``RayEpsilon`` · (1 + max |p|), at least 9e-5: far more than rounding errors require. Rays start
behind surfaces that are closer than that, and light is lost: a ball of radius 0.03 in a shell of
glass, at a distance of 0.2 % of the radius, is 37 % too dark in ``path``. Two kinds of scenes have
smaller offsets:

- In scenes smaller than 0.1 units, the size of the scene replaces the 1, as if the scene were
  enlarged to the size 1. Such scenes lose 1 to 2 % of their light where objects touch, and camera
  paths and light paths lose different parts of it.
- Where small transparent objects have another surface within the offset (``near_surfaces.py``), it
  follows the rounding errors of intersections. These are at most 5 units in the last place of the
  distance that a ray has flown, or of the largest coordinate of a triangle. Both are bounded by the
  size of the scene, cameras and lights included. (Measured with Embree, for meshes, spheres and
  disks. Intersections with cylinders and curves are 10 to 100 times less exact, and the errors on a
  GPU are not known: in both cases, scenes keep the other offsets.)

Source: M. Pharr et al., *Physically Based Rendering*, 4th edition, 2023, section 6.8 (managing
rounding error).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.bounds import scene_bounds
from ..scene.near_surfaces import has_near_surfaces

#: Scenes whose coordinates are all smaller than this have an offset of their own.
_SMALL = 0.1

#: The offset that follows rounding errors, relative to the size of the scene: 32 units in the last
#: place.
_ROUNDING = 2.0**-19


@dataclass(frozen=True)
class RayStarts:
    """Spawns rays at surfaces.

    Parameters:
        unit: The length that takes the place of Mitsuba's 1.
        exact: Whether the offset follows rounding errors. ``unit`` is then the size of the scene.

    With the defaults, rays are Mitsuba's.
    """

    unit: float = 1.0
    exact: bool = False

    def distance(self, p: mi.Point3f) -> mi.Float:
        """The offset of rays that leave a surface at ``p``."""
        epsilon = _ROUNDING if self.exact else mi.math.RayEpsilon
        return epsilon * (self.unit + dr.max(dr.abs(p)))

    def along(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
        """The ray that leaves ``si`` in the direction ``d``."""
        ray = si.spawn_ray(d)
        if self != RayStarts():
            ray.o = self._above(si.p, si.n, d)
        return ray

    def towards(
        self, si: mi.SurfaceInteraction3f, p: mi.Point3f, n: mi.Normal3f | None = None
    ) -> mi.Ray3f:
        """The ray from ``si`` that ends close before ``p``, a point of a surface with the normal
        ``n``; ``None`` if it is on no surface."""
        ray = si.spawn_ray_to(p)
        if self == RayStarts():
            return ray
        ray.o = self._above(si.p, si.n, p - si.p)
        # Mitsuba's rays end before surfaces that are close to the end
        is_exact = self.exact and n is not None
        way = (self._above(p, n, ray.o - p) if is_exact else p) - ray.o
        distance = dr.norm(way)
        ray.d = way / distance
        ray.maxt = distance if is_exact else distance * (1 - mi.math.ShadowEpsilon)
        return ray

    def _above(self, p: mi.Point3f, n: mi.Normal3f, d: mi.Vector3f) -> mi.Point3f:
        return p + dr.mulsign(self.distance(p), dr.dot(n, d)) * n


class SceneQuery:
    """How rays intersect the scene.

    Parameters (and attributes):
        starts: Where rays that leave a surface start; by default, the same as in Mitsuba.

    Attributes:
        has_chromatic_media: Whether the extinction of a medium may vary between colours. A render
            examines this before kernels are traced, where arrays cannot be read.
    """

    has_chromatic_media = False

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


def ray_starts(scene: mi.Scene) -> RayStarts:
    """The ray offsets of a scene."""
    # Mitsuba's box may be too small, where it merged rectangles, but is never too large
    size = _size(scene) if _extent(scene.bbox()) < _SMALL else 1.0
    starts = RayStarts(size) if 0 < size < _SMALL else RayStarts()

    def offset(far: float) -> float:
        return float(mi.math.RayEpsilon) * (starts.unit + far)

    if has_near_surfaces(scene, offset):
        size = _size(scene)
        if _ROUNDING * size < offset(0.0):
            return RayStarts(size, exact=True)
    return starts


def _size(scene: mi.Scene) -> float:
    """The largest coordinate of a scene, cameras and lights included: intersections are less exact
    for rays that come from far away."""
    box = scene_bounds(scene)
    for sensor in scene.sensors():
        box.expand(sensor.bbox())
    for emitter in scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
            box.expand(emitter.bbox())
            # Some point emitters have no bounding box
            to_world = np.array(emitter.world_transform().matrix).reshape(4, 4)
            box.expand(mi.ScalarPoint3f(to_world[:3, 3]))
    return _extent(box)


def _extent(box: mi.ScalarBoundingBox3f) -> float:
    """The largest coordinate of a box, not negative; 0 if there is none."""
    return float(np.abs([box.min, box.max]).max()) if box.valid() else 0.0
