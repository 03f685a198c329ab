"""Sample swarming: renders with maps of numbers that tiles of pixels share."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning import pilots
from mitsuba_ext.techniques.swarming import map_learner
from mitsuba_ext.techniques.swarming.bounce_records import BounceRecords
from mitsuba_ext.techniques.swarming.mapped_lights import light_cells
from mitsuba_ext.techniques.swarming.mapped_lobes import path_density
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    assert_exact,
    assert_same_pixels_on_average,
    batches,
    load,
)

pytestmark = pytest.mark.usefixtures("variant")

_OPTICS = {
    "aperture_radius": 0.1, "focus_distance": 3.0, "shutter_open": 0.25, "shutter_close": 0.75,
}  # fmt: skip


_ALL_ON = {"lobe_map": True, "direction_map": True}


def swarm(**parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "swarm_path", "max_depth": 4, **_ALL_ON, **parameters})


def _furnace() -> mi.Scene:
    """A room whose walls emit what they absorb, with a white thing that turns in it."""
    T = mi.ScalarTransform4f
    turns = {
        "back": ([1, 0, 0], 0), "front": ([1, 0, 0], 180), "floor": ([1, 0, 0], -90),
        "ceiling": ([1, 0, 0], 90), "left": ([0, 1, 0], 90), "right": ([0, 1, 0], -90),
    }  # fmt: skip
    wall = {"bsdf": diffuse(0.5), "emitter": area(0.5)}
    walls = {
        name: rectangle(T().rotate(*turn) @ T().translate([0, 0, -2]).scale([2, 2, 1]), **wall)
        for name, turn in turns.items()
    }
    cube = {"type": "cube", "to_world": T().scale(0.35), "bsdf": diffuse(1.0)}
    moving = {"type": "moving", "axis": [1, 2, 0.5], "angle": 200.0, "cube": cube}
    camera = sensor("thinlens", lookat([0, 0, 1.8], [0, 0, 0], [0, 1, 0]), film=film(), **_OPTICS)
    return mi.load_dict({"type": "scene", "sensor": camera, **walls, "thing": moving})


@pytest.mark.slow
def test_furnace_has_the_exact_radiance() -> None:
    integrator = swarm(always_use=True, max_depth=-1)
    assert_exact(batches(_furnace(), integrator, 128, [1, 2]), 1.0, precision=0.006)
    assert "uniform" not in integrator.statistics.learned


def _streaks(width: int = 24, height: int = 18, **changes: Any) -> mi.Scene:
    """A small bright ball that flies past, out of focus, and a lamp."""
    T = mi.ScalarTransform4f
    ball = {"type": "sphere", "radius": 0.15, "center": [-1, 0, 0.5], "bsdf": diffuse(0.8)}
    moving = {"type": "moving", "translate": [2, 0, 0.4], "ball": ball}
    lamp = rectangle(
        T().translate([0.8, 1.8, 1.2]).rotate([1, 0, 0], 90).scale(0.06), bsdf=diffuse(0.0),
        emitter=area(40.0),
    )  # fmt: skip
    changes = {"film": film(width, height), **_OPTICS, "shutter_open": 0.0, "shutter_close": 1.0,
               "aperture_radius": 0.3, **changes}  # fmt: skip
    camera = sensor("thinlens", **changes)
    return mi.load_dict(stage(camera=camera, moving=moving, lamp=lamp))


@pytest.mark.parametrize("variant", [
    "llvm_ad_rgb", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow),
], indirect=True)  # fmt: skip
def test_mean_agrees_with_uniform_numbers(variant: str) -> None:
    scene = _streaks()
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True), 256, [1, 2])
    tolerance = 9.0 if mi.is_spectral else 0.0
    assert_same_pixels_on_average(images, expected, 0.03, tolerance=tolerance)


@pytest.mark.slow
def test_maps_lower_the_noise_where_they_promise_to() -> None:
    scene = load("six_balls", width=96, height=54)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 2})
    noise = batches(scene, plain, 32, [1, 2]).var(axis=0).mean()
    integrator = swarm(max_depth=2)
    ours = batches(scene, integrator, 32, [1, 2]).var(axis=0).mean()
    assert ours < 0.6 * noise
    assert "less variance" in integrator.statistics.learned


def test_pilots_in_several_passes_count_each_sample_with_its_own_numbers() -> None:
    integrator = swarm(max_depth=2, samples_per_pass=3)
    mi.render(load("six_balls", width=64, height=36), integrator=integrator, spp=64)
    gain = re.search(r"times: .* about (\d+)% less variance", integrator.statistics.learned)
    assert gain and int(gain[1]) > 60, integrator.statistics.learned


@pytest.mark.slow
@pytest.mark.parametrize(("adversary", "kind"), [
    ("one_hot", "streaks"), ("random", "streaks"), ("one_hot", "glass"), ("random", "glass"),
])  # fmt: skip
def test_wrong_maps_only_make_noise(monkeypatch, adversary: str, kind: str) -> None:
    """All mass in one cell, or anywhere: the share of uniform numbers keeps the mean right."""

    def wrong(counts, squares, grid, widths):
        shape = (grid.count, len(widths))
        rng = np.random.default_rng(shape[0])
        if adversary == "random":
            mass = rng.random(shape) ** 4 * (widths.numpy() > 0)
        else:
            mass = np.zeros(shape)
            mass[:, shape[1] // 5] = 1
        return mi.Float((mass / mass.sum(-1, keepdims=True)).astype(np.float32).ravel())

    monkeypatch.setattr(map_learner, "estimate", wrong)
    scene, depth = (_streaks(12, 10), 2) if kind == "streaks" else (_glass_and_spots(), 5)
    plain = mi.load_dict({"type": "composed_path", "max_depth": depth})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True, max_depth=depth), 1024, [1, 2])
    assert_same_pixels_on_average(images, expected, 0.08)


@pytest.mark.parametrize(("gain", "efficiency"), [(0.5, 2), (0.99, 100), (17.8, 20)])
def test_a_gain_that_cannot_be_true_promises_little(gain: float, efficiency: float) -> None:
    """It is the ratio of two differences, which are mostly noise."""
    learner = map_learner.MapLearner.__new__(map_learner.MapLearner)
    learner.gain, learner.decision = gain, SimpleNamespace(maps=True)
    assert learner.efficiency == pytest.approx(efficiency)


@pytest.mark.parametrize("spp", [1, 3, 4])
def test_few_samples_cost_nothing(spp: int) -> None:
    integrator = swarm()
    mi.render(_streaks(5, 3), integrator=integrator, spp=spp)
    assert integrator.statistics.learned.startswith("nothing") == (spp < 4)


_CROPPED = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 5}


def test_each_pixel_has_its_sample_where_the_first_one_is_divided(monkeypatch) -> None:
    monkeypatch.setattr(pilots, "_LEAST_PIXELS", 1)
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": 0.5},
        "sensor": {**sensor(), "film": {**film(13, 11), **_CROPPED}},
    })  # fmt: skip
    integrator = swarm(always_use=True)
    image = np.array(mi.render(scene, integrator=integrator, spp=8))
    assert image.shape[:2] == (5, 7) and integrator.statistics.passes == 6
    assert integrator.statistics.spp == 8 and integrator.statistics.rays["camera"] == 8 * 35
    np.testing.assert_allclose(image, 0.5, rtol=1e-5)


@pytest.mark.slow
def test_mean_where_the_first_sample_is_divided(monkeypatch) -> None:
    monkeypatch.setattr(pilots, "_LEAST_PIXELS", 1)
    scene = _streaks(13, 11)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 512, [1001, 1002])
    images = batches(scene, swarm(always_use=True), 6, range(64))
    error = images.mean(axis=(1, 2, 3)).std(ddof=1) / 8 + expected.mean() * 0.003
    assert abs(images.mean() - expected.mean()) < 4 * error


def test_learned_maps_can_be_saved(tmp_path) -> None:
    scene, path = _streaks(), str(tmp_path / "maps.npz")
    learning = swarm(always_use=True, save_learned=path)
    first = batches(scene, learning, 64, [1])
    loaded = swarm(always_use=True, load_learned=path)
    again = batches(scene, loaded, 64, [2, 3])
    assert loaded.statistics.passes == 1 and "uniform" not in loaded.statistics.learned
    np.testing.assert_allclose(again.mean(), first.mean(), rtol=0.1)


def test_a_scene_names_it_and_wrong_values_are_named() -> None:
    text = str(swarm(lens_map=False, pilot_spp=8))
    assert "lens_map = False" in text and "pilot_spp = 8" in text and "aperture" not in text
    with pytest.raises((RuntimeError, TypeError), match="time_map"):
        swarm(time_map=3)
    with pytest.raises(RuntimeError, match="wavelength"):
        mi.load_dict({"type": "composed_path", "wavelength": "swarm"})


# ---- Lights, lobes, directions ----


def _glass_and_spots() -> mi.Scene:
    """A ball of glass and a pane before a wall, under a lamp and three spot lights."""
    T = mi.ScalarTransform4f
    glass = {"type": "dielectric", "int_ior": 1.6}
    things = {
        "ball": {"type": "sphere", "center": [0.5, -0.3, 0.5], "radius": 0.3, "bsdf": glass},
        "pane": rectangle(
            T().translate([-0.6, -0.6, 0.6]).rotate([1, 0, 0], 70).scale(0.5),
            bsdf={"type": "thindielectric"},
        ),
        "gloss": {"type": "sphere", "center": [-0.4, 0.5, 0.3], "radius": 0.3,
                  "bsdf": {"type": "roughplastic", "alpha": 0.1}},
    }  # fmt: skip
    for index, x in enumerate((-1.0, 0.0, 1.0)):
        things[f"spot_{index}"] = {
            "type": "spot", "to_world": lookat([x, -1, 1.8], [x / 2, 0, 0], [0, 1, 0]),
            "intensity": 1.0 + index, "cutoff_angle": 25.0,
        }  # fmt: skip
    return mi.load_dict(stage(camera=sensor(film=film(20, 16)), **things))


_ONE_MAP = {
    "light_map": "lights", "lobe_map": "lobes", "direction_map": "directions",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("only", [*_ONE_MAP, "all"])
def test_mean_with_maps_along_the_path(only: str) -> None:
    scene = _glass_and_spots()
    maps = {name: only in (name, "all") for name in _ONE_MAP}
    integrator = swarm(always_use=True, **maps)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 4})
    expected = batches(scene, plain, 256, [1001, 1002])
    images = batches(scene, integrator, 256, [1, 2])
    assert_same_pixels_on_average(images, expected, 0.03)
    learned = integrator.statistics.learned
    assert all((word in learned) == maps[name] for name, word in _ONE_MAP.items())
    assert "uniform" not in learned


def test_records_of_bounces_know_the_path_before_and_after() -> None:
    records = BounceRecords(2, 3)
    # Path 0 chooses at bounces 0 and 2, path 1 at bounce 1
    values = mi.Float([5, 9, 7, 4, 3, 8])
    records.density = mi.Float([1, 0, 0, 2, 0.5, 0])
    np.testing.assert_allclose(records.next_one(values).numpy()[[0, 3, 4]], [3, 0, 0])
    np.testing.assert_allclose(records.products(values).numpy()[[0, 3, 4]], [5, 4, 15])


def test_no_path_through_glass_weighs_more_than_the_share_of_uniform_numbers_allows() -> None:
    density = path_density(mi.Float([0, 1, 1e20])).numpy()
    np.testing.assert_allclose(density[:2], [0.2, 1], rtol=1e-6)
    assert 1e19 < density[2] < 1e20


def test_maps_of_lobes_lower_the_noise_of_panes() -> None:
    scene = load("panes", width=64, height=36)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 8})
    noise = batches(scene, plain, 64, [1, 2]).var(axis=0).mean()
    integrator = mi.load_dict({"type": "swarm_path", "max_depth": 8})
    ours = batches(scene, integrator, 64, [1, 2]).var(axis=0).mean()
    assert ours < 0.6 * noise
    assert "lobes: uniform" not in integrator.statistics.learned


@pytest.mark.parametrize("depth", [pytest.param(4, marks=pytest.mark.slow), -1])
def test_furnace_of_glass_is_exact(depth: int) -> None:
    scene = load("furnace_glass", width=16, height=16)
    integrator = swarm(always_use=True, max_depth=depth, rr_depth=1000)
    images = batches(scene, integrator, 64, [1, 2])
    if depth == -1:
        # Rounding at smooth glass: 4e-5 (docs/mitsuba_faults.md)
        assert_exact(images, 1.0, allowance=1e-4, precision=0.005)
        return
    plain = mi.load_dict({"type": "composed_path", "max_depth": depth, "rr_depth": 1000})
    expected = batches(scene, plain, 256, [1001, 1002])
    assert_same_pixels_on_average(images, expected, 0.01)


def test_lights_have_cells_of_their_probabilities() -> None:
    scene = mi.load_dict({
        "type": "scene",
        **{f"lamp_{i}": {"type": "point", "sampling_weight": w} for i, w in enumerate((1, 0, 3))},
    })  # fmt: skip
    widths = light_cells(scene, 0).widths
    assert sorted(widths[widths > 0]) == pytest.approx([0.25, 0.75])
    assert light_cells(scene, 1).dimension == 1


def test_learned_lights_are_refused_beside_maps_of_their_numbers() -> None:
    with pytest.raises(RuntimeError, match="lights that are not learned"):
        mi.load_dict({
            "type": "composed_path", "light_numbers": "swarm", "next_event": "contribution",
        })  # fmt: skip
