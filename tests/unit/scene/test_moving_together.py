"""Everything moves at once: camera, lights, things with scales and instances, before a sky."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.motions import LENS, at, camera, keyed, sky, uniform
from tests.support.stage import bitmap, diffuse, film, rectangle, rgb
from tests.support.statistical import (
    SEEDS,
    assert_same_image,
    assert_same_pixels_on_average,
    batches,
    two_halves,
)
from tests.support.techniques import TECHNIQUES

Scene = dict[str, Any]


@pytest.fixture(autouse=True)
def quiet(variant: str) -> None:
    mi.set_log_level(mi.LogLevel.Error)


def _turns() -> tuple[Scene, Any]:
    """Large turns, by the shorter way."""
    rotations = Rotation.from_rotvec([[0, 0, 0], [0, 0, 2.9], [2.0, -1.0, 1.5], [-0.3, 2.5, 0]])
    return keyed(
        [0.0, 0.3, 0.6, 1.0], rotations, [[0, 0, 0.1], [0.3, 0, 0], [0, -0.4, 0.3], [0, 0, 0]]
    )


def _roll() -> tuple[Scene, Any]:
    """The camera rolls by 170 degrees about its axis, and slides."""
    return uniform([0.3, 0.2, 0.1], [0, 1, -0.1], 170.0, [0, -4, 1.2])


def _swing() -> tuple[Scene, Any]:
    return uniform([0, 0, -0.2], [0, 1, 0], -400.0, [0.2, 0, 1.6], 0.1, 0.8)


def _sweep() -> tuple[Scene, Any]:
    rotations = Rotation.from_rotvec([[0, 0, 0], [0.2, 0, 1.0], [0.1, 0.3, -0.4]])
    return keyed([0.2, 0.5, 1.0], rotations, [[0, 0, 0], [0.2, 0.1, 0], [-0.4, 0.2, 0.2]])


def _things(pose: np.ndarray) -> Scene:
    """Under a scale that is not uniform, as it is and as an instance, also mirrored."""
    T = mi.ScalarTransform4f
    block = {"type": "cube", "to_world": T().rotate([1, 1, 0], 40).scale([0.2, 0.5, 0.3]),
             "bsdf": {"type": "roughplastic", "alpha": 0.3}}  # fmt: skip
    return {
        "block": {**block, "bsdf": diffuse(0.2, 0.7, 0.3), "to_world": at(
            pose, T().translate([0.5, 0, 0.5]).scale([0.8, -0.3, 1.1]), block["to_world"])},
        "group": {"type": "shapegroup", "id": "group", "block": block},
        "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": at(
            pose, T().translate([-0.5, 0.1, 0.6]).scale([0.7, 0.5, 1.3]))},
        "tube": {"type": "cylinder", "p0": [0, 0, -0.5], "p1": [0, 0, 0.5], "radius": 0.15,
                 "bsdf": {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.2}},
                 "to_world": at(
                     pose, T().translate([0, 0.3, 0.7]).rotate([0, 1, 0], 50).scale(0.9))},
    }  # fmt: skip


def _lamp(pose: np.ndarray) -> Scene:
    """A textured light whose surface reflects."""
    pixels = np.random.default_rng(3).uniform(0, 8, (4, 4, 3))
    radiance = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    T = mi.ScalarTransform4f
    place = at(pose, T().translate([0.2, 0.2, 0.9]).rotate([1, 0, 0], 170).scale([0.4, 0.2, 1]))
    return rectangle(place, bsdf=diffuse(0.3), emitter={"type": "area", "radiance": radiance})


def _spot(pose: np.ndarray) -> Scene:
    place = at(pose, mi.ScalarTransform4f().look_at([-0.6, -0.8, 1.7], [0, 0.2, 0], [0, 0, 1]))
    return {
        "type": "spot",
        "to_world": place,
        "intensity": rgb(3.0, 2.0, 2.0),
        "cutoff_angle": 35.0,
    }


def _scene(things: Scene, view: Scene, lamp: Scene, spot: Scene) -> mi.Scene:
    floor = rectangle(mi.ScalarTransform4f().scale([2, 2, 1]), bsdf=diffuse())
    lights = {"lamp": lamp, "spot": spot} if lamp else {}
    return mi.load_dict(
        {"type": "scene", "sensor": view, "floor": floor, "sky": sky(), **things, **lights},
        optimize=False,
    )


def _moving(begin: float, end: float, lights: bool = True, **changes: Any) -> mi.Scene:
    rest = np.eye(4)
    view = {"type": "moving_camera", **_roll()[0], "camera": camera(begin, end, **changes)}
    things = {"moving": {"type": "moving", **_turns()[0], **_things(rest)}}
    lamp = {"type": "moving", **_swing()[0], "lamp": _lamp(rest)} if lights else {}
    return _scene(things, view, lamp, {"type": "moving_light", **_sweep()[0], "spot": _spot(rest)})


def _resting(time: float, lights: bool = True, **changes: Any) -> mi.Scene:
    still = camera(0.0, 0.0, **changes)
    view = {**still, "to_world": at(_roll()[1](time), still["to_world"])}
    lamp = _lamp(_swing()[1](time)) if lights else {}
    return _scene(_things(_turns()[1](time)), view, lamp, _spot(_sweep()[1](time)))


@pytest.mark.parametrize(("time", "hide"), [
    (0.45, True),
    *(pytest.param(*case, marks=pytest.mark.slow)
      for case in ((0.05, False), (0.05, True), (0.45, False), (0.85, False), (0.85, True))),
])  # fmt: skip
def test_closed_shutter_shows_all_at_its_time(time: float, hide: bool) -> None:
    """With the same random numbers."""
    changes = {**LENS, "film": film(24, 18)}
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 4, "hide_emitters": hide})
    one, other = (
        batches(scene, integrator, 16, [5])[0]
        for scene in (_moving(time, time, **changes), _resting(time, **changes))
    )
    assert_same_image(one, other, share=0.96)


AOVS = "z:depth,p:position,n:sh_normal,g:geo_normal,i:prim_index,uv:uv,a:albedo"


def test_output_variables_show_the_scene_at_the_time_of_the_ray() -> None:
    changes = {**LENS, "film": film(40, 30)}
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 1, "aovs": AOVS})
    one, other = (
        batches(scene, integrator, 1, [3])[0]
        for scene in (_moving(0.85, 0.85, **changes), _resting(0.85, **changes))
    )
    # Rounding decides what rays at edges meet
    assert (np.isclose(one, other, rtol=3e-3, atol=3e-3).mean(axis=(0, 1)) > 0.98).all()


@functools.cache
def _reference(lights: bool) -> np.ndarray:
    """Images of scenes at rest, averaged over 64 times in the middle of strata."""
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    images = []
    for i in range(64):
        scene = _resting((i + 0.5) / 64, lights, **LENS)
        images.append(batches(scene, integrator, 64, [1001 + i, 2001 + i]))
    return np.mean(images, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lights"), [
    ("composed_path", True), ("neepp", True), ("pss_guided", True), ("swarm_path", True),
    ("many_connections", True), ("bdpt", False), ("composed_path", False),
])  # fmt: skip
def test_image_is_the_average_of_images_at_rest(name: str, lights: bool) -> None:
    images = two_halves(_moving(0.0, 1.0, lights, **LENS), TECHNIQUES[name].make(4), 4096, SEEDS)
    assert_same_pixels_on_average(images, _reference(lights), precision=0.006, tile=4)
