"""Merging: the images of ``vcm`` and ``sppm``."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.merging.merging import median_footprint
from mitsuba_ext.estimators.light_paths.merging.shared_numbers import (
    TIME_STEP,
    WAVELENGTH_STEP,
    SharedNumbers,
)
from mitsuba_ext.transport.scene_query import SceneQuery
from tests.support.furnaces import FURNACES
from tests.support.stage import area, bitmap, film, lookat, sensor, stage
from tests.support.statistical import assert_same_mean, batches, load, some

pytestmark = pytest.mark.usefixtures("variant")


def make(name: str, max_depth: int = 4, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": max_depth, **parameters})


def _meters(*targets: list[float], kind: str = "radiancemeter") -> dict:
    """A batch of meters that look at these points of :func:`stage`."""
    origin = np.array([0, -4, 1.2])
    meters = {
        f"meter_{i}": {"type": kind, "origin": origin.tolist(), "film": film(1, 1),
                       "direction": (np.array(target) - origin).tolist()}
        for i, target in enumerate(targets)
    }  # fmt: skip
    return {"type": "batch", "film": film(len(targets), 1), **meters}


def test_the_pixels_of_radiance_meters_have_no_width() -> None:
    scene = mi.load_dict(stage(camera=_meters([0, -0.5, 0], [-0.5, 0, 0])))
    assert median_footprint(scene, scene.sensors()[0], SceneQuery()) == 0
    ball = {"type": "sphere", "center": [0, -0.5, 0.5], "radius": 0.1,
            "meter": {"type": "irradiancemeter", "film": film(1, 1)}}  # fmt: skip
    scene = mi.load_dict(stage(camera={}, ball=ball))
    assert median_footprint(scene, scene.sensors()[0], SceneQuery()) > 0.1


# ---- Images ----


@pytest.mark.parametrize("name", some("sppm", of=["sppm", "vcm", "photon_map", "bdpt"]))
def test_a_mask_before_a_hidden_sky_keeps_the_light_it_reflects(name: str) -> None:
    """A card under a white sky, whose opacity is 0.25 on the left and 0.75 on the right."""
    opacity = np.repeat(np.repeat([[[0.25], [0.75]]], 8, axis=0), 4, axis=1)
    mask = {"type": "mask", "opacity": {"type": "bitmap", "bitmap": bitmap(opacity), "raw": True,
                                        "filter_type": "nearest"}}  # fmt: skip
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant"},
        "card": {"type": "rectangle", "bsdf": {**mask, "bsdf": white}},
        "sensor": sensor(to_world=view, fov=14.0, film=film(16, 16)),
    })  # fmt: skip
    images = batches(scene, make(name, hide_emitters=True), 256, range(1, 7)).mean(axis=(1, 3))
    found = sorted(images[:, part].mean() for part in (slice(0, 7), slice(9, 16)))
    np.testing.assert_allclose(found, [0.125, 0.375], rtol=0.02)


def test_sppm_shows_what_radiance_meters_see() -> None:
    """Many samples of few pixels: disks once held no photon."""
    scene = mi.load_dict(stage(camera=_meters([0, -0.7, 0], [-0.6, -0.2, 0])))
    images = batches(scene, make("sppm"), 8192, range(1, 9))[:, 0].mean(axis=-1)
    path = mi.load_dict({"type": "path", "max_depth": 4})
    expected = batches(scene, path, 4096, [9, 10])[:, 0].mean(axis=-1).mean(axis=0)
    assert (images > 0).all()
    np.testing.assert_allclose(images.mean(axis=0), expected, rtol=0.2)


@pytest.mark.parametrize("parameters", [{"merging": "none"}, {}])
def test_without_caustics_the_image_agrees_with_bdpt(parameters: dict) -> None:
    scene = load("cornell_box", width=16, height=12)
    images = [
        batches(scene, make(name, **more), 8, [1])
        for name, more in (("bdpt", {}), ("vcm", parameters))
    ]
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("name", "parameters"), [
    ("vcm", {}), pytest.param("vcm", {"merging": "all"}, marks=pytest.mark.slow),
    pytest.param("vcm", {"light_paths": 4.0, "connections": 0}, marks=pytest.mark.slow),
    pytest.param("sppm", {}, marks=pytest.mark.slow),
    pytest.param("sppm", {"light_paths": 0.5}, marks=pytest.mark.slow),
])  # fmt: skip
def test_caustics_have_the_mean_of_path(name: str, parameters: dict) -> None:
    """A large lamp, a ball of glass, and a mirror: ``path`` finds the caustics too."""
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    mirror = {
        "type": "rectangle", "bsdf": {"type": "conductor"},
        "to_world": mi.ScalarTransform4f().translate([0, 1.4, 0.5]).rotate([1, 0, 0], 90),
    }  # fmt: skip
    scene = mi.load_dict(stage(ball=ball, mirror=mirror), optimize=False)
    radius = 0.03 if name == "vcm" else 0.01
    found = batches(scene, make(name, 6, radius=radius, **parameters), 128, range(1, 9))
    expected = batches(scene, make("path", 6), 2048, range(101, 109))
    # The bias of the radius, at edges
    assert_same_mean(found, expected, 0.03, tolerance=0.0)


@pytest.mark.parametrize("name", ["bdpt", "vcm"])
def test_a_sensor_of_one_ray_has_the_radiance_of_path(name: str) -> None:
    """Mitsuba samples a single ray for all lanes of a ``radiancemeter``."""
    camera = {
        "type": "radiancemeter", "film": film(1, 1),
        "to_world": mi.ScalarTransform4f().look_at([0, -4, 1.2], [0, 0, 0.6], [0, 0, 1]),
    }  # fmt: skip
    scene = mi.load_dict(stage(camera=camera), optimize=False)
    images = [batches(scene, make(kind), 4096, range(1, 9)) for kind in (name, "path")]
    means = [image[..., :3].mean() for image in images]
    assert means[0] == pytest.approx(means[1], rel=0.1)


@pytest.mark.parametrize("radius", [pytest.param(0.8, marks=pytest.mark.slow), 0.4])
def test_the_bias_is_the_mean_over_a_disk(radius: float) -> None:
    """Light of a point at height 1 falls as (1 + d²)^(-3/2) with the distance from below it."""
    T = mi.ScalarTransform4f
    light = {"type": "spot", "cutoff_angle": 40.0, "beam_width": 39.9, "intensity": 1.0,
             "to_world": T().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])}  # fmt: skip
    floor = {"type": "rectangle", "to_world": T().scale(4), "bsdf": {"type": "diffuse"}}
    camera = {"type": "perspective", "fov": 0.5, "film": film(1, 1),
              "to_world": T().look_at([0, -2, 0.8], [0, 0, 0], [0, 0, 1])}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "floor": floor, "light": light, "sensor": camera})
    integrator = make("sppm", 2, radius=radius * 64, radius_decay=1.0)
    found = batches(scene, integrator, 4096, range(1, 9)).mean() * 2 * math.pi
    # 3/4 radius² for small ones
    assert found == pytest.approx(2 * (1 - (1 + radius**2) ** -0.5) / radius**2, rel=0.03)


@pytest.mark.parametrize("name", ["sppm", pytest.param("vcm", marks=pytest.mark.slow)])
def test_images_do_not_depend_on_the_scale_of_the_scene(name: str) -> None:
    means = []
    for scale in (1.0, 1e-3, 1e4):
        world = mi.ScalarTransform4f().scale(scale)
        ball = {"type": "sphere", "center": [0, 0, 0.5 * scale], "radius": 0.4 * scale,
                "bsdf": {"type": "dielectric"}}  # fmt: skip
        camera = sensor(
            to_world=lookat([0, -4 * scale, 1.2 * scale], [0, 0, 0.6 * scale], [0, 0, 1]),
            near_clip=0.01 * scale, far_clip=100.0 * scale,
        )  # fmt: skip
        scene = mi.load_dict(stage(world, camera=camera, ball=ball), optimize=False)
        means.append(batches(scene, make(name, 5), 64, [1, 2]).mean())
    assert means[1:] == pytest.approx([means[0]] * 2, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["vcm", "sppm"])
def test_the_bias_falls_with_the_radius(name: str) -> None:
    furnace = FURNACES["furnace_box"]
    (region,) = [r for r in furnace.regions if r.exact(3) is not None][:1]
    parameters = {"merging": "all"} if name == "vcm" else {}
    scene = load("furnace_box", width=16, height=16)
    biases = []
    for radius in (0.8, 0.4):
        integrator = make(name, 3, radius=radius, radius_decay=1.0, **parameters)
        images = batches(scene, integrator, 16, range(1, 65))
        biases.append(1 - images.mean() / region.exact(3))
    # In the corners of the box a part of the disk is missing: in proportion to the radius
    assert 0.005 < biases[0] < 0.1 and biases[1] < 0.7 * biases[0]


def test_light_does_not_leak_through_a_thin_wall() -> None:
    T = mi.ScalarTransform4f
    wall = {"type": "diffuse"}
    lit = {"type": "rectangle", "bsdf": wall, "to_world": T().translate([0, 0, 1e-4])}
    dark = {"type": "rectangle", "bsdf": wall, "to_world": T().rotate([1, 0, 0], 180)}
    light = {"type": "rectangle", "emitter": area(5.0),
             "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.2)}  # fmt: skip
    camera = {"type": "perspective", "fov": 30.0, "film": film(8, 8),
              "to_world": T().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0])}  # fmt: skip
    scene = mi.load_dict({"type": "scene", "lit": lit, "dark": dark, "light": light,
                          "sensor": camera}, optimize=False)  # fmt: skip
    for integrator in (make("sppm", radius=0.1), make("vcm", merging="all", radius=0.1)):
        assert np.array(mi.render(scene, integrator=integrator, spp=16)).max() == 0


def test_a_plate_does_not_light_what_lies_under_it() -> None:
    """Both face up, and lie within the radius: half of that above the other."""
    T = mi.ScalarTransform4f
    light = {"type": "rectangle", "emitter": area(5.0),
             "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.2)}  # fmt: skip
    camera = {"type": "perspective", "fov": 20.0, "film": film(8, 8), "near_clip": 0.001,
              "to_world": T().look_at([0, -0.2, 0.1], [0, 0, 0], [0, 0, 1])}  # fmt: skip
    plate = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
    above = {**plate, "to_world": T().translate([0, 0, 0.2])}
    scene = mi.load_dict({"type": "scene", "below": plate, "above": above, "light": light,
                          "sensor": camera}, optimize=False)  # fmt: skip
    # With 16 light paths per pixel, the radius is 0.4
    image = np.array(mi.render(scene, integrator=make("sppm", 2, radius=1.6), spp=16))
    assert image.max() == 0


def test_weights_add_up_to_one_behind_mirrors_and_glass() -> None:
    """In a closed room of one temperature, each pixel has the radiance 1."""
    scene = load("furnace_isothermal", width=32, height=32)
    integrator = make("vcm", -1, radius=0.2, radius_decay=1.0)
    images = batches(scene, integrator, 16, range(1, 9))[..., :3]
    assert images.mean() == pytest.approx(1, abs=0.004)


# ---- Wavelengths and times ----


@pytest.mark.parametrize("step", [TIME_STEP, WAVELENGTH_STEP])
def test_shared_numbers_are_even_and_the_same_for_all_pixels(step: int) -> None:
    index = dr.arange(mi.UInt32, 64)
    found = [SharedNumbers(step, seed, 1).draw(None, 5 * index, index) for seed in (3, 3, 4)]
    a, b, other = (number.numpy() for number, weight in found)
    assert (a == b).all() and not (a == other).any() and found[0][1] == 1
    gaps = 64 * np.diff(np.sort(a))
    assert gaps.min() > 0.1 and gaps.max() < 5


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("name", ["vcm", pytest.param("sppm", marks=pytest.mark.slow)])
@pytest.mark.parametrize("glass", [
    "dielectric", pytest.param("dispersive_dielectric", marks=pytest.mark.slow),
])  # fmt: skip
def test_spectral_caustics_have_the_mean_of_path(variant: str, name: str, glass: str) -> None:
    """Only vertices of the same wavelengths merge."""
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": glass}}
    scene = mi.load_dict(stage(ball=ball), optimize=False)
    everywhere = {"merging": "all"} if name == "vcm" else {}
    found = batches(scene, make(name, 5, radius=0.03, **everywhere), 128, range(1, 9))
    reference = "composed_path" if glass == "dispersive_dielectric" else "path"
    expected = batches(scene, make(reference, 5), 1024, range(101, 109))
    assert_same_mean(found, expected, 0.03, tolerance=0.1)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("name", ["sppm", "vcm"])
def test_the_hero_counts_once_where_both_paths_are_dispersed(variant: str, name: str) -> None:
    """A floor under a plate of dispersive glass, through which light and camera see it."""
    T = mi.ScalarTransform4f
    plate = {"type": "cube", "bsdf": {"type": "dispersive_dielectric"},
             "to_world": T().translate([0, 0, 0.1]).scale([3, 3, 0.05])}  # fmt: skip
    scene = mi.load_dict(stage(plate=plate, block=None), optimize=False)
    means = [
        batches(scene, make(kind, 7, **more), spp, range(1, 5))[..., 8:, :, :].mean()
        for kind, spp, more in ((name, 64, {"radius": 0.2}), ("composed_path", 1024, {}))
    ]
    assert means[0] == pytest.approx(means[1], rel=0.1)


@pytest.mark.parametrize("name", ["vcm", pytest.param("sppm", marks=pytest.mark.slow)])
def test_moving_glass_has_the_mean_of_path(name: str) -> None:
    """Only vertices of the same time merge."""
    ball = {"type": "sphere", "center": [-0.3, 0, 0.5], "radius": 0.4,
            "bsdf": {"type": "dielectric"}}  # fmt: skip
    moving = {"type": "moving", "translate": [0.6, 0, 0], "in": ball}
    camera = sensor(shutter_open=0.0, shutter_close=1.0)
    scene = mi.load_dict(stage(camera=camera, ball=moving), optimize=False)
    found = batches(scene, make(name, 5, radius=0.03), 128, range(1, 9))
    expected = batches(scene, make("composed_path", 5), 1024, range(101, 109))
    assert_same_mean(found, expected, 0.03, tolerance=0.0)


# ---- Errors ----


def test_images_of_techniques_are_refused() -> None:
    with pytest.raises(RuntimeError, match='"technique_images" cannot be combined with merging'):
        make("vcm", technique_images="a.exr")
    make("vcm", merging="none", technique_images="a.exr")
