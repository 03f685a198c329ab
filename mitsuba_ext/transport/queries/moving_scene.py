"""Ray intersection in a scene with moving shapes. Each mover is a scene of its own: rays are
transformed to the frame in which its shapes rest."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.motion.rigid_motion import Pose, PoseTable
from ...util.arrays import from_numpy
from ..path_decisions import SceneQuery
from ..scene_query import RayStarts
from .box import Box

#: The owner of shapes that do not move.
_NOBODY = 0xFFFFFFFF


class MovingSceneQuery(SceneQuery):
    """Intersects rays with the static scene and with each mover.

    Parameters:
        scene: The static scene.
        moving: The movers, from :func:`movers`.
        starts: Where rays that leave a surface start.

    Attributes:
        scenes (list[mi.Scene]): The shapes of each mover, at rest.
    """

    def __init__(
        self, scene: mi.Scene, moving: Sequence[mi.Shape], starts: RayStarts
    ) -> None:
        super().__init__(starts)
        self.scenes = [mover.at_rest for mover in moving]
        self._poses = PoseTable([mover.motion for mover in moving])
        self._boxes = [Box(mover.bbox()) for mover in moving]
        self._owners = self._find_owners(scene, moving)
        self._lights = self._find_lights(moving)

    def closest(self, scene, ray, coherent, active):
        pi = super().closest(scene, ray, coherent, active)
        ray = mi.Ray3f(ray)
        for index, (at_rest, box) in enumerate(zip(self.scenes, self._boxes)):
            # Shapes behind the closest hit so far cannot be hit
            ray.maxt = dr.select(pi.valid, pi.t, ray.maxt)
            pi = dr.if_stmt(
                (pi, ray),
                active & box.is_met(ray),
                functools.partial(self._closer, at_rest, index, coherent),
                lambda pi, _ray: pi,
                label="mover",
            )
        return pi

    def _closer(self, at_rest, index, coherent, pi, ray):
        found = at_rest.ray_intersect_preliminary(
            self._to_rest(mi.UInt32(index), ray), coherent=coherent, reorder=False
        )
        return dr.select(found.valid, found, pi)

    def interaction(self, pi, ray):
        owner, moves = self.owner(pi)
        # A single call of the shape's method, for resting and moving shapes together
        ray = dr.if_stmt((owner, ray), moves, self._to_rest, lambda _owner, ray: ray)
        si = super().interaction(pi, ray)
        return dr.if_stmt((owner, si), moves, self._to_world, lambda _owner, si: si)

    def owner(self, pi: mi.PreliminaryIntersection3f) -> tuple[mi.UInt32, mi.Bool]:
        """The number of the mover that a ray has hit, and whether it has hit one."""
        shape = dr.select(pi.instance != None, pi.instance, pi.shape)  # noqa: E711
        number = _number(shape)
        # Lightweight shapes have numbers that the table may not have
        known = pi.valid & (number < dr.width(self._owners))
        owner = dr.gather(mi.UInt32, self._owners, number, known)
        return owner, known & (owner != _NOBODY)

    def pose(self, index: mi.UInt32, time: mi.Float) -> Pose:
        """The pose of a mover."""
        return self._poses.pose(index, time)

    def emitter(self, si, emitter):
        if self._lights is None:
            return emitter
        number = _number(si.shape)
        light = dr.gather(mi.UInt32, self._lights, number, number < dr.width(self._lights))
        number = dr.reinterpret_array(mi.UInt32, emitter)
        return dr.reinterpret_array(mi.EmitterPtr, dr.select(light > 0, light, number))

    def occluded(self, scene, si, ds, active):
        ray = self.shadow_ray(scene, si, ds)
        occluded = scene.ray_test(ray, active=active)
        for index, (at_rest, box) in enumerate(zip(self.scenes, self._boxes)):
            occluded = dr.if_stmt(
                (occluded, ray),
                active & ~occluded & box.is_met(ray),
                functools.partial(self._blocks, at_rest, index),
                lambda occluded, _ray: occluded,
                label="mover",
            )
        return occluded

    def _blocks(self, at_rest, index, _occluded, ray):
        return at_rest.ray_test(self._to_rest(mi.UInt32(index), ray))

    # ---- Helpers ----

    def _to_rest(self, index: mi.UInt32, ray: mi.Ray3f) -> mi.Ray3f:
        return self.pose(index, ray.time).to_rest(ray)

    def _to_world(self, index: mi.UInt32, si: mi.SurfaceInteraction3f) -> mi.SurfaceInteraction3f:
        return self.pose(index, si.time).to_world(si)

    def _find_owners(self, scene: mi.Scene, moving: Sequence[mi.Shape]) -> mi.UInt32:
        """The index of the mover to which a shape belongs, by the number of the shape."""
        numbers = [[_number_of(shape) for shape in scene.shapes()]]
        numbers += [[_number_of(shape) for shape in at_rest.shapes()] for at_rest in self.scenes]
        owners = np.full(max(map(max, numbers)) + 1, _NOBODY, dtype=np.uint32)
        taken = set(numbers[0])
        for index, mover in enumerate(moving):
            if not taken.isdisjoint(numbers[index + 1]):
                raise ValueError(
                    f'"{mover.name}": a shape that is nested in it is elsewhere in the scene as '
                    f"well; give each place a shape of its own (or an instance of a shapegroup)"
                )
            taken.update(numbers[index + 1])
            owners[numbers[index + 1]] = index
        return from_numpy(mi.UInt32, owners)


    def _find_lights(self, moving: Sequence[mi.Shape]) -> mi.UInt32 | None:
        """The number of each moving light in the scene, by the number of its shape at rest;
        ``None`` if no light moves."""
        lights = {}
        for mover in moving:
            if mover.is_emitter():
                (shape,) = (child for child in mover.children if child.is_emitter())
                light = dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(mover.emitter()))
                lights[_number_of(shape)] = int(light[0])
        if not lights:
            return None
        table = np.zeros(max(lights) + 1, dtype=np.uint32)
        table[list(lights)] = list(lights.values())
        return from_numpy(mi.UInt32, table)


def _number(shape: mi.ShapePtr) -> mi.UInt32:
    return dr.reinterpret_array(mi.UInt32, shape)


def _number_of(shape: mi.Shape) -> int:
    return int(_number(mi.ShapePtr(shape))[0])
