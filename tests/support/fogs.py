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


def leaves_and_windows() -> Scene:
    """What lets rays pass without turning them: half transparent and thin glass."""
    T = mi.ScalarTransform4f
    leaf = {"type": "mask", "opacity": 0.4, "bsdf": diffuse(0.6)}
    window = {"type": "rectangle", "to_world": T().translate([0, 0, 1.6]).scale(1.5),
              "bsdf": {"type": "thindielectric"}}  # fmt: skip
    return fog("area", fog=cube(homogeneous(), bsdf=leaf), window=window)


def empty_cloud() -> Scene:
    """A grid with holes: the density is zero there."""
    density = np.zeros((4, 4, 4, 1), dtype=np.float32)
    density[::2, 1:3, ::2] = 6.0
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density),
              "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}  # fmt: skip
    return fog("point", {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.9})


def mixed() -> Scene:
    """Media that meet, glass and a half transparent leaf in them, under lights of several kinds."""
    scene = fog_around_the_camera("area", homogeneous([0.1, 0.15, 0.2], 0.9))
    around = {"type": "ref", "id": "around"}
    T = mi.ScalarTransform4f
    leaf = {"type": "rectangle", "to_world": T().translate([0.5, 1, 0.5]).rotate([1, 0, 0], 70),
            "bsdf": {"type": "mask", "opacity": 0.4, "bsdf": diffuse(0.6)}}  # fmt: skip
    return {
        **scene,
        "outer": cube(homogeneous(0.8, 0.9, 0.9), 0.9, exterior=around),
        "inner": cube(homogeneous(2.0, 0.9, -0.5), 0.4,
                      exterior=homogeneous(0.8, 0.9, 0.9)),
        "ball": {"type": "sphere", "radius": 0.5, "center": [1.6, -0.6, 0.8],
                 "bsdf": {"type": "roughdielectric", "alpha": 0.3}, "exterior": around},
        "leaf": leaf,
        "spot": {"type": "spot", "intensity": 20.0, "to_world": lookat([-2, 2, 3], [0, 0, 0],
                 [0, 1, 0])},
        "sky": {"type": "constant", "radiance": 0.1},
    }  # fmt: skip


def glass_in_fog() -> Scene:
    """A ball of glass in fog."""
    ball = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "dielectric"},
            "exterior": {"type": "ref", "id": "around"}}  # fmt: skip
    return {**fog_around_the_camera("area", homogeneous(0.2)), "ball": ball}


def caustic_in_fog() -> Scene:
    """A large lamp, whose light a ball of glass bundles in coloured fog."""
    medium = {**homogeneous([0.6, 0.8, 1.0], 0.9), "id": "medium"}
    ball = {"type": "sphere", "radius": 0.45, "center": [0.1, 0.5, 0.0],
            "bsdf": {"type": "dielectric"}, "exterior": {"type": "ref", "id": "medium"}}
    lamp = {"type": "sphere", "radius": 0.8, "center": [0.3, 3.0, 0.5], "emitter": area(6.0)}
    scene = fog(medium={"type": "ref", "id": "medium"}, ball=ball)
    return {"type": "scene", "medium": medium, **scene, "light": lamp}


def without_boundary() -> Scene:
    """Fog everywhere: only the sensor knows of it."""
    scene = {k: v for k, v in fog("area_inside").items() if k != "fog"}
    return {**scene, "sensor": {**scene["sensor"], "medium": homogeneous(0.1)}}


def skin() -> Scene:
    """A ball of a dense medium with a rough boundary."""
    ball = {"type": "sphere", "interior": homogeneous([2.0, 3.0, 5.0], [0.95, 0.9, 0.8], 0.0),
            "bsdf": {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.4}}  # fmt: skip
    return fog("area", fog=ball)


SCENES = {
    "lamp_outside": lambda: fog("area"),
    "lamp_inside": lambda: fog("area_inside"),
    "point_inside": lambda: fog("point_inside"),
    "sky": lambda: fog("environment"),
    "sun": lambda: fog("directional"),
    "chromatic": lambda: fog("area", homogeneous([0.2, 0.5, 0.9], [0.9, 0.6, 0.3])),
    "forward": lambda: fog("area", homogeneous(g=0.8)),
    "backward": lambda: fog("area", homogeneous(g=-0.6)),
    "thick": lambda: fog("area", homogeneous(8.0, 0.95)),
    "grid": lambda: fog("area", grid()),
    "around_the_camera": lambda: fog_around_the_camera("area_inside", homogeneous(0.2)),
    "without_boundary": without_boundary,
    "nested": lambda: fog("area", inner=cube(homogeneous(3.0), 0.4, exterior=homogeneous())),
    "without_emitter_sampling": lambda: fog("area", homogeneous(sample_emitters=False)),
    "glass_in_fog": glass_in_fog,
    "skin": skin,
}

#: More of them, with what makes media hard.
HARD_SCENES = {
    "leaves": leaves_and_windows,
    "empty_cloud": empty_cloud,
    "white": lambda: fog("area", homogeneous(1.0, 1.0)),
    "black": lambda: fog("area", homogeneous(1.0, 0.0)),
    "mixed": mixed,
}


def _medium(kind: str, g: float, **parameters: Any) -> Scene:
    phase = {"type": "hg", "g": g} if g else {"type": "isotropic"}
    colours = {k: rgb(*v) if isinstance(v, list) else v for k, v in parameters.items()}
    return {"type": kind, "phase": phase, **colours}
