"""Offsets the origins of rays that leave a surface, so that they do not hit it again.

Mitsuba's offset is ``RayEpsilon`` · (1 + max |p|). In scenes smaller than 0.1 units, the 1 is far
more than rounding errors require. A scene of a few thousandths of a unit loses 1 to 2 % of its
light where objects touch, because rays start behind nearby surfaces; camera paths and light paths
lose different parts of it. In such scenes, the size of the scene replaces the 1, as if the scene
were enlarged to the size 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.bounds import scene_bounds

#: Scenes whose coordinates are all smaller than this have an offset of their own.
_SMALL = 0.1


@dataclass(frozen=True)
class RayStarts:
    """Spawns rays at surfaces.

    Parameters:
        unit: The length that takes the place of Mitsuba's 1. With 1, rays are those of Mitsuba.
    """

    unit: float = 1.0

    def distance(self, p: mi.Point3f) -> mi.Float:
        """The offset of rays that leave a surface at ``p``."""
        return mi.math.RayEpsilon * (self.unit + dr.max(dr.abs(p)))

    def along(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Ray3f:
        """The ray that leaves ``si`` in the direction ``d``."""
        ray = si.spawn_ray(d)
        if self.unit != 1:
            ray.o = self._above(si, d)
        return ray

    def towards(self, si: mi.SurfaceInteraction3f, p: mi.Point3f) -> mi.Ray3f:
        """The ray from ``si`` that ends close before ``p``."""
        ray = si.spawn_ray_to(p)
        if self.unit != 1:
            ray.o = self._above(si, p - si.p)
            way = p - ray.o
            distance = dr.norm(way)
            ray.d = way / distance
            ray.maxt = distance * (1 - mi.math.ShadowEpsilon)
        return ray

    def _above(self, si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Point3f:
        return si.p + dr.mulsign(self.distance(si.p), dr.dot(si.n, d)) * si.n


def ray_starts(scene: mi.Scene) -> RayStarts:
    """The ray offsets of a scene. Its size includes cameras and lights: intersections are less
    exact for rays that come from afar."""
    # Mitsuba's box may be too small, where it merged rectangles, but is never too large
    if _extent(scene.bbox()) >= _SMALL:
        return RayStarts()
    box = scene_bounds(scene)
    for sensor in scene.sensors():
        box.expand(sensor.bbox())
    for emitter in scene.emitters():
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
            box.expand(emitter.bbox())
            # Some point emitters have no bounding box
            to_world = np.array(emitter.world_transform().matrix).reshape(4, 4)
            box.expand(mi.ScalarPoint3f(to_world[:3, 3]))
    extent = _extent(box)
    return RayStarts(extent) if 0 < extent < _SMALL else RayStarts()


def _extent(box: mi.ScalarBoundingBox3f) -> float:
    """The largest coordinate of a box, not negative; 0 if there is none."""
    return float(np.abs([box.min, box.max]).max()) if box.valid() else 0.0
