"""Rigid motions, as parameters of plugins and as poses that are computed here; and things that
move, in a room."""

from __future__ import annotations

import functools
from typing import Any, Callable

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tests.support.stage import area, bitmap, diffuse, rectangle, sensor

Scene = dict[str, Any]

#: The matrix of a time.
Pose = Callable[[float], np.ndarray]


def uniform(translate, axis, angle, center, begin=0.0, end=1.0) -> tuple[Scene, Pose]:
    def pose(time: float) -> np.ndarray:
        x = np.clip((time - begin) / (end - begin), 0, 1)
        unit = np.array(axis) / np.linalg.norm(axis)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(unit * np.radians(x * angle)).as_matrix()
        matrix[:3, 3] = x * np.array(translate) + center - matrix[:3, :3] @ center
        return matrix

    parameters = {"translate": translate, "axis": axis, "angle": angle, "center": center,
                  "begin": begin, "end": end}  # fmt: skip
    return parameters, pose


def keyed(times, rotations: Rotation, positions) -> tuple[Scene, Pose]:
    slerp, positions = Slerp(times, rotations), np.array(positions)

    def pose(time: float) -> np.ndarray:
        time = np.clip(time, times[0], times[-1])
        matrix = np.eye(4)
        matrix[:3, :3] = slerp(time).as_matrix()
        matrix[:3, 3] = [np.interp(time, times, column) for column in positions.T]
        return matrix

    parameters: Scene = {}
    for i, time in enumerate(times):
        parameters[f"time_{i}"] = float(time)
        parameters[f"pose_{i}"] = mi.ScalarTransform4f(pose(time))
    return parameters, pose


# ---- Things, and where they are ----


def at(pose: np.ndarray, *rest: mi.ScalarTransform4f) -> mi.ScalarTransform4f:
    return functools.reduce(lambda a, b: a @ b, rest, mi.ScalarTransform4f(pose))


def pair(pose: np.ndarray) -> Scene:
    """A block and a ball."""
    T = mi.ScalarTransform4f
    return {
        "block": {"type": "cube", "bsdf": diffuse(0.2, 0.7, 0.3),
                  "to_world": at(pose, T().translate([0.4, 0, 0.4]).scale([0.25, 0.15, 0.3]))},
        "ball": {"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": 0.2},
                 "to_world": at(pose, T().translate([-0.35, 0.1, 0.5]).scale(0.25))},
    }  # fmt: skip


def plate(pose: np.ndarray) -> Scene:
    T = mi.ScalarTransform4f
    bsdf = {"type": "twosided", "bsdf": diffuse(0.8, 0.4, 0.1)}
    to_world = at(pose, T().translate([-0.6, 0.4, 0.9]).rotate([1, 0, 0], 60).scale(0.3))
    return {"plate": {"type": "rectangle", "bsdf": bsdf, "to_world": to_world}}


def room(camera: Scene, **things: Any) -> Scene:
    """A floor, a mirror behind, and a lamp (large, as the mirror's caustic is sampled badly)."""
    T = mi.ScalarTransform4f
    upright = T().translate([0, 1.5, 1]).rotate([1, 0, 0], 90)
    return {
        "type": "scene",
        "sensor": camera,
        "floor": rectangle(T().scale([2, 2, 1]), bsdf=diffuse()),
        "mirror": rectangle(upright, T().scale([2, 1, 1]), bsdf={"type": "conductor"}),
        "lamp": rectangle(
            T().translate([-0.3, 0, 1.9]).rotate([1, 0, 0], 180).scale(0.9),
            bsdf=diffuse(0.0),
            emitter=area(1.5),
        ),
        **things,
    }


def camera(begin: float = 0.0, end: float = 1.0, plugin: str = "perspective", **changes) -> Scene:
    return sensor(plugin, shutter_open=begin, shutter_close=end, **changes)


def sky() -> Scene:
    """A sky that is not uniform: without noise, rounding errors of long sums would stand out."""
    pixels = np.random.default_rng(4).uniform(0.2, 0.6, size=(8, 16, 3))
    return {"type": "envmap", "bitmap": bitmap(pixels)}


LENS = {"plugin": "thinlens", "aperture_radius": 0.15, "focus_distance": 4.0}
