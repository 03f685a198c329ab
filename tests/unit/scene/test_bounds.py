"""The bounds of scenes, which Mitsuba 3.9.1 misjudges, and shadow rays that do not rely on them."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.bounds import scene_bounds
from tests.support.stage import diffuse, film, lookat, sensor
from tests.support.statistical import batches

pytestmark = pytest.mark.usefixtures("variant")


def test_bounds_hold_merged_rectangles():
    T = mi.ScalarTransform4f()
    sides = {f"side_{z}": {"type": "rectangle", "to_world": T.translate([0, 0, z]).scale(9),
                          "bsdf": diffuse()}
             for z in (0, 5)}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 0.2}, **sides})
    assert len(scene.shapes()) == 2  # Mitsuba has merged shapes
    box = scene_bounds(scene)
    np.testing.assert_allclose([list(box.min), list(box.max)], [[-9, -9, -0.2], [9, 9, 5]])
    assert not scene_bounds(mi.load_dict({"type": "scene"})).valid()


@pytest.mark.parametrize("moves", [False, True])
def test_shadow_rays_end_at_the_light_or_never(moves):
    """A roof that Mitsuba merges with the floor, a sky, and a lamp under the roof: the lamp lights
    (its shadow rays end), the sky does not (its shadow rays do not end before the roof)."""
    T = mi.ScalarTransform4f()
    sides = {f"side_{z}": {"type": "rectangle", "to_world": T.translate([0, 0, z]).scale(100),
                           "bsdf": {"type": "twosided", "bsdf": diffuse()}} for z in (0, 5)}
    camera = sensor(to_world=lookat([0, -4, 1.2], [0, 0, 0], [0, 0, 1]), film=film(8, 8), fov=20.0)
    thing = {"type": "sphere", "radius": 0.1, "center": [0, 0, 3]}
    if moves:
        thing = {"type": "moving", "translate": [0.1, 0, 0], "thing": thing}
    lamp = {"type": "rectangle", "to_world": T.translate([0, 0, 4]).rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": 3.0}}  # fmt: skip

    integrator = mi.load_dict({"type": "composed_path", "max_depth": 2})

    def mean(**lights: dict) -> float:
        scene = mi.load_dict({"type": "scene", "sensor": camera, **sides, "thing": thing, **lights})
        return batches(scene, integrator, 64, [1]).mean()

    sky = {"type": "constant"}
    assert mean(sky=sky) < 0.01
    assert mean(sky=sky, lamp=lamp) == pytest.approx(mean(lamp=lamp), rel=0.1)
