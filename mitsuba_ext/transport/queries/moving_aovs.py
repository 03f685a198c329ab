"""Output variables of moving shapes: Mitsuba's ``aov`` evaluates them for the shapes at rest, and
points and vectors are then transformed to the world at the time of the ray."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi

from ...scene.motion.rigid_motion import Pose
from .moving_scene import MovingSceneQuery

#: The channel counts of variables with several channels, and the variables that a motion changes.
_CHANNELS = {"albedo": 3, "uv": 2, "duv_dx": 2, "duv_dy": 2}
_POINTS, _VECTORS = ("position",), ("geo_normal", "sh_normal", "dp_du", "dp_dv")


def moving_aovs(
    aov: mi.SamplingIntegrator,
    aovs: str,
    query: MovingSceneQuery,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.RayDifferential3f,
) -> list[mi.Float]:
    """The channels of ``aov`` along camera rays, at their times.

    Parameters:
        aov: Mitsuba's integrator, made with the list ``aovs``.
        query: How rays intersect the scene.
    """
    pi = query.closest(scene, ray, coherent=True, active=mi.Bool(True))
    owner, moves = query.owner(pi)
    values = aov.sample(scene, sampler, ray, None, ~moves)[2]
    for index, at_rest in enumerate(query.scenes):
        mine = moves & (owner == index)
        pose = query.pose(mi.UInt32(index), ray.time)
        found = aov.sample(at_rest, sampler, pose.ray_to_rest(ray), None, mine)[2]
        found = _to_world(pose, aovs, found)
        values = [dr.select(mine, new, old) for new, old in zip(found, values)]
    return values


def _to_world(pose: Pose, aovs: str, values: list[mi.Float]) -> list[mi.Float]:
    moved: list[mi.Float] = []
    for item in filter(None, re.split("[, ]", aovs)):  # as Mitsuba splits it
        kind = item.partition(":")[2]
        is_moved = kind in _POINTS + _VECTORS
        part = values[len(moved) :][: 3 if is_moved else _CHANNELS.get(kind, 1)]
        if kind in _POINTS:
            part = list(pose.point_to_world(mi.Point3f(*part)))
        elif kind in _VECTORS:
            part = list(pose.rotation @ mi.Vector3f(*part))
        moved += part
    return moved
