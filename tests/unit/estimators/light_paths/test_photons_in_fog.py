"""Photons in participating media: ``sppm`` in fog."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.light_media import outer_medium
from mitsuba_ext.estimators.light_paths.merging.merging_in_media import FlightLine
from mitsuba_ext.estimators.light_paths.merging.merging_radius import MergingRadius
from mitsuba_ext.transport.path_decisions import SceneQuery
from tests.support.fogs import (
    SCENES,
    camera,
    cube,
    fog,
    fog_around_the_camera,
    homogeneous,
    skin,
    without_boundary,
)
from tests.support.stage import area, diffuse, lookat, sensor
from tests.support.statistical import assert_images_are_sound, assert_same_quarters, batches, some

pytestmark = pytest.mark.usefixtures("variant")

#: In passes of 1024 samples per pixel, balls have a tenth of this radius.
_RADII = {"radius": 0.1, "radius_in_media": 0.3}


def make(name: str = "sppm", max_depth: int = 6, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": max_depth, **parameters})


@pytest.mark.parametrize("name", some("chromatic", of=SCENES))
def test_fog_has_the_mean_of_volpath(name: str) -> None:
    scene = mi.load_dict(SCENES[name](), optimize=False)
    found = batches(scene, make(**_RADII), 1024, range(1, 7))
    expected = batches(scene, make("volpath"), 1024, range(101, 107))
    assert_same_quarters(found, expected, 0.04)


def test_light_inside_a_rough_boundary_is_gathered_there() -> None:
    """A camera path that merged photons at the boundary would find few through its narrow lobe:
    220 times the variance."""
    scene = mi.load_dict(skin(), optimize=False)
    images = batches(scene, make(**_RADII), 256, range(1, 5))[:, 5:11, 5:11]
    assert_images_are_sound(images)
    variance = 256 * images.var(axis=0, ddof=1).mean()
    assert variance < 0.02
    assert images.mean() == pytest.approx(0.021, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_fog_has_the_mean_of_volpath(variant: str) -> None:
    scene = mi.load_dict(fog("environment"), optimize=False)
    # Photons of a pass have wavelengths of their own: its samples do not shrink the radius
    parameters = {"radius": 0.05, "radius_in_media": 0.06}
    found = batches(scene, make(**parameters), 1024, range(1, 9))
    assert_same_quarters(found, batches(scene, make("volpath"), 1024, range(101, 109)), 0.03)


def test_white_fog_in_a_white_world_is_invisible() -> None:
    """Also within the radius of its surface, where a ball reaches out of the fog."""
    scene = mi.load_dict({"type": "scene", "sensor": camera(), "fog": cube(homogeneous(2.0, 1.0)),
                          "sky": {"type": "constant"}}, optimize=False)  # fmt: skip
    wide = make(max_depth=-1, radius_in_media=0.2 * 64 ** (1 / 3), radius_decay=1.0)
    images = batches(scene, wide, 64, range(1, 3))
    assert_images_are_sound(images)
    # 27 % of the film show the fog
    assert images.mean() == pytest.approx(1, abs=0.012)


def test_a_photon_counts_as_if_the_whole_line_met_it() -> None:
    """Points of a flight from 0 to 1 find a photon beside its ends, or in the middle."""
    count, radius, σ = 4000, 0.3, 3.0
    t = (dr.arange(mi.Float, count) + 0.5) / count
    none, d = mi.Normal3f(0), mi.Vector3f(1, 0, 0)
    for photon in ([0.02, 0.1, 0], [0.5, 0, 0.2], [0.95, 0.1, 0.05]):
        offset = mi.Vector3f(photon) - t * d
        line = FlightLine(d, mi.Float(radius), σ, t, 1 - t, none, none)
        found = dr.select(dr.norm(offset) < radius, dr.exp(-σ * t) * line.weight(offset), 0)
        chord = 2 * (radius**2 - photon[1] ** 2 - photon[2] ** 2) ** 0.5
        assert dr.mean(found)[0] == pytest.approx(chord * np.exp(-σ * photon[0]), rel=2e-3)
    behind = mi.Vector3f(0.55, 0, 0) - t * d
    wall = FlightLine(d, mi.Float(radius), σ, t, 0.5 - t, none, mi.Normal3f(-1, 0, 0))
    assert not dr.any(wall.weight(behind) > 0)


def _lamp_in_fog(size: float) -> mi.Scene:
    T = mi.ScalarTransform4f
    view = lookat([0, 0.3 * size, 6 * size], [0, 0, 0], [0, 1, 0])
    lamp = {"type": "sphere", "radius": 0.3 * size, "emitter": area(5.0), "bsdf": diffuse(0.0)}
    floor = {"type": "rectangle", "bsdf": diffuse(0.5),
             "to_world": T().translate([0, -0.8 * size, 0]).rotate([1, 0, 0], -90).scale(2 * size)}
    return mi.load_dict({
        "type": "scene", "lamp": lamp, "floor": floor,
        "fog": cube(homogeneous(1 / size), size),
        "sensor": sensor(to_world=view, fov=30.0, near_clip=0.01 * size, far_clip=100 * size),
    }, optimize=False)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-3, 1e4])
def test_the_size_of_the_scene_does_not_matter(size: float) -> None:
    images = [batches(_lamp_in_fog(s), make(max_depth=5), 16, range(1, 5)) for s in (1.0, size)]
    assert_images_are_sound(images[1])
    assert images[1].mean() == pytest.approx(images[0].mean(), rel=0.03)


def test_balls_shrink_in_volume_as_disks_do_in_area() -> None:
    radius = MergingRadius(2.0, 0.75, pixels=100, footprint=0.1, dimensions=3)
    found = [radius.next(100) for _ in range(16)]
    assert found[0] == 2 and found[15] == pytest.approx(2 * 16 ** (-1 / 12))
    assert MergingRadius(2.0, 0.75, 100, 0.1, dimensions=3).next(800) == pytest.approx(1)


def test_the_medium_outside_is_that_behind_the_last_boundary() -> None:
    def outside(scene: dict) -> bool:
        loaded = mi.load_dict(scene)
        medium = outer_medium(SceneQuery(), loaded, loaded.sensors()[0])
        return bool(dr.all(medium != None))  # noqa: E711

    assert outside(without_boundary())
    assert not outside(fog()) and not outside(fog_around_the_camera())
    hole = {"type": "sphere", "radius": 3.0, "bsdf": {"type": "null"}, "exterior": homogeneous()}
    assert outside({**without_boundary(), "hole": hole})


@pytest.mark.parametrize("name", ["instant_radiosity", "photon_map"])
def test_others_with_light_paths_refuse_media_and_name_sppm(name: str) -> None:
    with pytest.raises(NotImplementedError, match='do not scatter in a medium.*"sppm"'):
        make(name).render(mi.load_dict(fog()), spp=1)


def test_a_small_lamp_through_glass_lights_the_fog() -> None:
    """A point light, which ``volpath`` cannot reach through the glass."""
    ball = {"type": "sphere", "center": [0, 1.4, 0], "radius": 0.35, "bsdf": {"type": "dielectric"}}
    spot = {"type": "spot", "cutoff_angle": 10.0, "intensity": 50.0,
            "to_world": lookat([0, 3, 0], [0, 1, 0], [1, 0, 0])}  # fmt: skip
    scene = mi.load_dict(fog(light="point") | {"light": spot, "ball": ball}, optimize=False)
    image = np.array(mi.render(scene, integrator=make(), spp=256)).mean(axis=2)
    # Below the ball, the light crosses the axis of the picture
    assert image[6:10, 7:9].mean() > 5 * image[6:10, 4:6].mean() > 0
    assert np.array(mi.render(scene, integrator=make("volpath"), spp=16)).max() == 0
