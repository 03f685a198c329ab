"""Scenes with participating media, for tests."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.stage import area, diffuse, film, lookat, rgb, sensor

Scene = dict[str, Any]


def homogeneous(sigma_t: Any = 1.0, albedo: Any = 0.8, g: float = 0.3, **other: Any) -> Scene:
    """A homogeneous medium; lists are colours."""
    # Mitsuba's colours end at 1
    scale = max(sigma_t) if isinstance(sigma_t, list) else 1.0
    if isinstance(sigma_t, list):
        sigma_t = [x / scale for x in sigma_t]
    return _medium("homogeneous", g, albedo=albedo, sigma_t=sigma_t, scale=scale, **other)


def grid(sigma_t: float = 1.0, albedo: Any = 0.8, g: float = 0.3) -> Scene:
    """A medium of random density, ``sigma_t`` on average, in the cube from −1 to 1."""
    density = np.random.default_rng(3).random((6, 5, 7, 1), dtype=np.float32) * 2 * sigma_t
    place = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density), "to_world": place}
    return _medium("heterogeneous", g, albedo=albedo, sigma_t=volume)


def cube(medium: Scene, size: float = 1.0, **other: Any) -> Scene:
    """An index-matched cube of half the edge ``size`` around the origin."""
    place = mi.ScalarTransform4f().scale(size)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium,
            **other}  # fmt: skip


#: What can light the scenes.
LIGHTS: dict[str, Scene] = {
    "point": {"type": "point", "position": [0.5, 2.5, 2.0], "intensity": 10.0},
    "point_inside": {"type": "point", "position": [0.3, 0.5, 0.2], "intensity": 3.0},
    "area": {"type": "sphere", "radius": 0.3, "center": [0.5, 2.5, 2.0], "emitter": area(20.0)},
    "area_inside": {
        "type": "sphere", "radius": 0.15, "center": [-0.4, 0.4, 0.2], "emitter": area(18.0)
    },
    "environment": {"type": "constant", "radiance": rgb(0.5, 0.8, 1.0)},
    "directional": {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": 3.0},
}  # fmt: skip


def fog(light: str = "point", medium: Scene | None = None, **other: Any) -> Scene:
    """A cube of fog above a floor; ``None`` leaves something out."""
    floor = mi.ScalarTransform4f().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(4)
    return {
        "type": "scene",
        "sensor": camera(),
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": diffuse(0.5)},
        "fog": cube(medium or homogeneous()),
        "light": LIGHTS[light],
        **other,
    }


def camera(**other: Any) -> Scene:
    view = lookat([0, 0.3, 6], [0, 0, 0], [0, 1, 0])
    return sensor(to_world=view, fov=40.0, film=film(16, 16), **other)


def fog_around_the_camera(light: str = "point", medium: Scene | None = None) -> Scene:
    """The camera looks from within a large ball of fog."""
    scene = fog(light)
    ball = {"type": "sphere", "radius": 20.0, "bsdf": {"type": "null"},
            "interior": {"type": "ref", "id": "around"}}  # fmt: skip
    around = {**(medium or homogeneous(0.1)), "id": "around"}
    eye = {**scene["sensor"], "medium": {"type": "ref", "id": "around"}}
    return {"type": "scene", "around": around, **{k: v for k, v in scene.items() if k != "type"},
            "sensor": eye, "fog": ball}  # fmt: skip


def _medium(kind: str, g: float, **parameters: Any) -> Scene:
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    colours = {k: rgb(*v) if isinstance(v, list) else v for k, v in parameters.items()}
    return {"type": kind, "phase": phase, **colours}
