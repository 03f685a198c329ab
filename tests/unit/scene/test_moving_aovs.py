"""Output variables show moving objects at the time of each ray."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.motions import at, camera, keyed, pair, plate, room, uniform
from tests.support.stage import bitmap, diffuse, film

Scene = dict[str, Any]

AOVS = ("a:albedo,z:depth,p:position uv:uv,g:geo_normal,n:sh_normal,u:dp_du,v:dp_dv,dx:duv_dx,"
        "dy:duv_dy,i:prim_index")  # fmt: skip

KEYS = ([0.1, 0.4, 0.9], Rotation.from_rotvec([[0, 0, 0], [0, 0.5, 1.2], [-0.6, 0.5, 2.9]]),
        [[-0.3, 0, 0], [0.4, 0, 0.2], [0, -0.3, 0.1]])  # fmt: skip


@pytest.fixture(autouse=True)
def quiet(variant: str) -> None:
    mi.set_log_level(mi.LogLevel.Error)


def _things(pose: np.ndarray) -> Scene:
    """With a normal map, whose shading frame is its own."""
    normals = {"type": "bitmap", "bitmap": bitmap(np.full((2, 2, 3), [0.6, 0.4, 0.9])), "raw": True}
    bumped = {"type": "normalmap", "normalmap": normals, "bsdf": diffuse(0.3, 0.6, 0.2)}
    T = mi.ScalarTransform4f
    place = at(pose, T().translate([0.2, -0.5, 1.1]).scale(0.25))
    return {**pair(pose), "bumped": {"type": "sphere", "to_world": place, "bsdf": bumped}}


def _image(scene: Scene, aovs: str, spp: int, seed: int = 3) -> np.ndarray:
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 1, "aovs": aovs})
    return np.array(integrator.render(mi.load_dict(scene), seed=seed, spp=spp))


def _moving_room(begin: float, end: float) -> Scene:
    """Two things that move differently, seen by a camera that moves."""
    still = camera(begin, end, film=film(40, 30))
    seen_from = {"type": "moving_camera", "translate": [0.2, 0, 0.1], "still": still}
    first, second = keyed(*KEYS)[0], {"axis": [0, 0, 1.0], "angle": 80.0}
    return room(seen_from, first={"type": "moving", **first, **_things(np.eye(4))},
                second={"type": "moving", **second, **plate(np.eye(4))})  # fmt: skip


def _still_room(time: float) -> Scene:
    still = camera(0.0, 0.0, film=film(40, 30))
    there = mi.ScalarTransform4f().translate([0.2 * time, 0, 0.1 * time])
    turn = uniform([0, 0, 0], [0, 0, 1], 80.0, [0, 0, 0])[1]
    things = {**_things(keyed(*KEYS)[1](time)), **plate(turn(time))}
    return room({**still, "to_world": there @ still["to_world"]}, **things)


@pytest.mark.parametrize(
    "variant", ["llvm_ad_rgb", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow)],
    indirect=True,
)  # fmt: skip
def test_a_closed_shutter_shows_the_output_variables_of_its_time(variant: str) -> None:
    moving, still = (_image(scene, AOVS, 1) for scene in (_moving_room(0.55, 0.55),
                                                          _still_room(0.55)))  # fmt: skip
    assert moving.shape == still.shape
    same = np.isclose(moving, still, rtol=2e-3, atol=2e-3)
    # Rounding decides what rays at edges meet
    assert (same.mean(axis=(0, 1)) > 0.98).all(), same.mean(axis=(0, 1))
    rest = _image(_moving_room(-1, -1), AOVS, 1)
    assert np.isclose(moving, rest, rtol=2e-3, atol=2e-3).mean() < 0.9


def test_shapes_are_told_apart() -> None:
    moving, still = (_image(scene, "s:shape_index", 1)[..., 3]
                     for scene in (_moving_room(0.55, 0.55), _still_room(0.55)))  # fmt: skip
    numbers = np.unique(still)
    assert len(numbers) >= 6
    for number in numbers:
        mine = moving[still == number]
        values, counts = np.unique(mine, return_counts=True)
        assert counts.max() > 0.9 * len(mine)
        assert (still[moving == values[counts.argmax()]] == number).mean() > 0.9


@pytest.mark.slow
def test_open_shutter_shows_the_mean() -> None:
    aovs = "z:depth,p:position,n:sh_normal"
    image = _image(_moving_room(0.0, 1.0), aovs, 1024)
    stills = [_image(_still_room((i + 0.5) / 64), aovs, 16, seed=i) for i in range(64)]
    wanted = np.mean(stills, axis=0)
    assert np.abs(image - wanted)[..., 3:].mean() < 0.02 * np.abs(wanted)[..., 3:].mean()
    blur = np.abs(stills[32] - wanted)[..., 3:].mean()
    assert blur > 0.05 * np.abs(wanted)[..., 3:].mean()
