"""Path guiding is unbiased, more efficient behind a door, and off where it gains nothing."""

from __future__ import annotations

import math
import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.hard_cases import HARD_CASES
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_image,
    assert_same_pixels_on_average,
    batches,
    load,
    two_halves,
)
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")

TILES = {"regions": "tiles", "tile": 5}


def guided(max_depth: int = 5, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "pss_guided", "max_depth": max_depth, **parameters})


def insisting(max_depth: int = 5, **parameters: Any) -> mi.Integrator:
    """Guides even if the estimated gain is too small, as on most films of tests."""
    return guided(max_depth, always_guide=True, **parameters)


def hidden_lamp(camera: dict | None = None, **changes: Any) -> mi.Scene:
    """A box lit by a spot on its ceiling: the lamp stands on a shelf."""
    T = mi.ScalarTransform4f
    view = lookat([0, -3.2, 1], [0, 0, 1], [0, 0, 1])
    room = T().translate([0, -1, 1]).scale([1.5, 3, 1])
    shelf = T().translate([0.7, 0.5, 1.75]).scale([0.4, 0.4, 0.02])
    lamp = T().translate([0.7, 0.5, 1.8]).scale([0.1, 0.1, 1])
    scene = {
        "type": "scene",
        "sensor": camera or sensor(to_world=view, film=film(24, 24)),
        "room": {"type": "cube", "to_world": room, "flip_normals": True,
                 "bsdf": diffuse(0.7, 0.6, 0.5)},
        "shelf": {"type": "cube", "to_world": shelf, "bsdf": diffuse(0.3)},
        "lamp": rectangle(lamp, bsdf=diffuse(0.0), emitter=area(100.0)),
        **changes,
    }  # fmt: skip
    return mi.load_dict({key: value for key, value in scene.items() if value is not None})


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    mi.set_variant("llvm_ad_rgb")
    return two_halves(hidden_lamp(), REFERENCE.make(5), 8192, REFERENCE_SEEDS)


# ---- The mean ----


@pytest.mark.parametrize(
    "parameters",
    [
        {"bounces": 1},
        {"bounces": 4},
        {**TILES, "bounces": 2},
        {**TILES, "bounces": 5},
        {"bounces": 3, "nee_first_bounce": False},
        *(
            pytest.param(parameters, marks=pytest.mark.slow)
            for parameters in (
                {"bounces": 2},
                {**TILES, "bounces": 1},
                {**TILES, "tile": 64, "bounces": 3, "nee_first_bounce": False},
                {**TILES, "tile": 1},
            )
        ),
    ],
    ids=str,
)
def test_mean_agrees_with_path_whatever_is_guided(
    parameters: dict[str, Any], reference: np.ndarray
) -> None:
    integrator = insisting(pilot_spp=128, **parameters)
    images = two_halves(hidden_lamp(), integrator, 2048, SEEDS)
    assert integrator.guide.bounces == min(parameters.get("bounces", 2), 4)
    precision = 0.01 if parameters.get("nee_first_bounce", True) else 0.03
    assert_same_pixels_on_average(images, reference, precision)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameters", "most"),
    [({}, 0.8), ({**TILES, "tile": 10}, 0.93)],
    ids=["surfaces", "tiles"],
)
def test_guiding_lowers_the_variance_behind_a_door(parameters: dict, most: float) -> None:
    """In nearly all pixels: light comes by way of a streak on the floor. The learner finds that the
    regions of surfaces are worth their time."""
    scene = load("door_ajar", width=64, height=36)

    def logarithm(integrator: mi.Integrator, seeds: range) -> float:
        images = batches(scene, integrator, 96, seeds[:3]).mean(axis=3)
        return np.log(images.var(axis=0, ddof=1) + 1e-9).mean()

    integrator = guided(6, always_guide=bool(parameters), **parameters)
    ratio = logarithm(integrator, SEEDS) - logarithm(REFERENCE.make(6), REFERENCE_SEEDS)
    assert integrator.guide is not None and math.exp(ratio) < most, math.exp(ratio)
    assert integrator.learner.guidance.gain > 0.05
    assert "% less variance" in integrator.statistics.learned


def test_early_roulette_keeps_the_mean_of_long_paths() -> None:
    scene = load("cornell_box", width=16, height=16, rfilter="box")
    integrator = insisting(-1, rr_depth=2)
    images = two_halves(scene, integrator, 1024, SEEDS)
    assert integrator.guide is not None
    reference = two_halves(scene, REFERENCE.make(-1, rr_depth=20), 2048, REFERENCE_SEEDS)
    assert_same_pixels_on_average(images, reference, precision=0.02)


@pytest.mark.parametrize("parameters", [{}, TILES], ids=["surfaces", "tiles"])
def test_memory_bounds_what_is_recorded(
    parameters: dict[str, Any], reference: np.ndarray
) -> None:
    """A hundred samples of 37,000: trees are poor, and the mean is right."""
    integrator = insisting(max_memory=0.015, **parameters)
    images = two_halves(hidden_lamp(), integrator, 1024, SEEDS)
    assert_same_pixels_on_average(images, reference, precision=0.015)
    assert 20 < integrator.learner.sample_count < 120


@pytest.mark.parametrize("spp", [1, 11])
def test_too_few_samples_for_pilots_give_the_image_of_path(spp: int) -> None:
    scene, integrator = hidden_lamp(), insisting()
    image, path = (batches(scene, i, spp, [5])[0] for i in (integrator, REFERENCE.make(5)))
    assert integrator.guide is None and integrator.statistics.passes == 1
    assert_same_image(image, path)


def test_three_pilots_of_one_sample_keep_the_mean(reference: np.ndarray) -> None:
    integrator = insisting()
    images = batches(hidden_lamp(), integrator, 13, SEEDS[:8])
    assert integrator.guide is not None
    assert (integrator.statistics.passes, integrator.statistics.spp) == (4, 13)
    assert_same_pixels_on_average(images, reference, precision=0.1)


# ---- Without connections at the first vertex ----


def test_later_connections_alone_have_the_mean_of_path() -> None:
    """Connections to delta lights remain, because BSDF samples cannot hit them."""
    point = {"type": "point", "position": [0.8, -1, 1.5], "intensity": {"type": "rgb", "value": 1}}
    for more in ({}, {"point": point}):
        scene = mi.load_dict(stage(**more))
        later = guided(4, nee_first_bounce=False, pilot_spp=0)
        images = two_halves(scene, later, 2048, SEEDS)
        reference = two_halves(scene, REFERENCE.make(4), 2048, REFERENCE_SEEDS)
        assert_same_pixels_on_average(images, reference, precision=0.02)


def test_no_shadow_ray_leaves_the_first_vertex() -> None:
    scene = mi.load_dict(stage())
    later = guided(2, nee_first_bounce=False)
    assert batches(scene, later, 16, [1]).any()
    assert later.statistics.rays["shadow"] == later.statistics.connections == 0


# ---- Nothing to learn, or too little gain ----


def _mirrors() -> dict:
    mirror = {"type": "conductor"}
    return stage(floor=rectangle(bsdf=mirror), wall=None, block=None)


_NOTHING_TO_GAIN = [
    ("furnace_convex", 4), ("plain", 2), ("plain", 1), ("no_light", 4), ("empty", 4),
    ("empty_before_environment", 4), ("light_that_nothing_sees", 4), ("mirrors", 4),
    ("delta_lights", 2),
]  # fmt: skip


@pytest.mark.parametrize("parameters", [{}, TILES], ids=["surfaces", "tiles"])
@pytest.mark.parametrize(("scene_name", "max_depth"), _NOTHING_TO_GAIN)
def test_nothing_is_guided_where_nothing_is_gained(
    scene_name: str, max_depth: int, parameters: dict[str, Any]
) -> None:
    if scene_name.startswith("furnace"):
        scene = load(scene_name, width=16, height=16)
    else:
        make = _mirrors if scene_name == "mirrors" else HARD_CASES[scene_name].make
        scene = mi.load_dict(make())
    integrator = guided(max_depth, **parameters)
    image = batches(scene, integrator, 256, SEEDS[:2])
    assert integrator.guide is None
    learned = integrator.statistics.learned
    assert learned.startswith("no guide: ") if integrator.learner else learned == ""
    reference = batches(scene, REFERENCE.make(max_depth), 512, REFERENCE_SEEDS[:2])
    if reference.any():
        # Rays that mirrors lead to a small lamp are few
        precision = 0.15 if scene_name == "mirrors" else 0.05
        assert_same_pixels_on_average(image, reference, precision)
    else:
        assert not image.any()


# ---- State ----


@pytest.mark.parametrize(
    "parameters", [{}, pytest.param(TILES, marks=pytest.mark.slow)], ids=["surfaces", "tiles"]
)
def test_renders_in_between_change_nothing(parameters: dict[str, Any]) -> None:
    """Another scene, another film, another number of samples, another seed."""
    scene, integrator = hidden_lamp(), insisting(**parameters)
    first = batches(scene, integrator, 48, [7])[0]
    batches(mi.load_dict(stage(camera=sensor(film=film(31, 9)))), integrator, 20, [7])
    batches(scene, integrator, 64, [8])
    wide = mi.load_dict(sensor(to_world=lookat([0, -3, 1], [0, 0, 1.5], [0, 0, 1])))
    integrator.render(scene, wide, seed=7, spp=16)
    again = batches(scene, integrator, 48, [7])[0]
    np.testing.assert_allclose(again, first, rtol=1e-5, atol=1e-5 * first.mean())


@pytest.mark.parametrize("parameters, few", [({}, 1), (TILES, 16)], ids=["surfaces", "tiles"])
def test_another_seed_compiles_little(parameters: dict[str, Any], few: int) -> None:
    """Other numbers of samples and of nodes share the kernels of the first renders; but a forest
    in which a single node is split has its own."""
    scene, integrator = hidden_lamp(), insisting(**parameters)
    batches(scene, integrator, 64, SEEDS[:4])
    before = dr.detail.launch_stats()[2]
    batches(scene, integrator, 64, SEEDS[4:8])
    assert dr.detail.launch_stats()[2] - before <= few


# ---- Parameters ----


def test_parameters_are_shown() -> None:
    for parameters, shown in (
        ({}, ["regions = surfaces", "bounces = 6", "pilot_spp = 32", "max_memory = 512.0"]),
        ({"regions": "tiles"}, ["regions = tiles", "tile = 16", "bounces = 2"]),
        ({"max_depth": 7, "bounces": 3, "nee_first_bounce": False},
         ["max_depth = 7", "bounces = 3", "connections = ", "count = 0", "vertices = first"]),
    ):  # fmt: skip
        text = str(mi.load_dict({"type": "pss_guided", **parameters}))
        assert text.startswith("pss_guided[")
        assert all(re.search(rf"[ \[]{line}\b", text) for line in shown), text
        assert ("tile =" in text) == (parameters.get("regions") == "tiles")


@pytest.mark.parametrize(
    ("parameter", "value"), [("bounces", 6), ("bounces", 0), ("tile", 0), ("tile", 2.5)]
)
def test_wrong_values_of_tiles_are_named(parameter: str, value: Any) -> None:
    with pytest.raises((RuntimeError, ValueError, TypeError)) as caught:
        mi.load_dict({"type": "pss_guided", "regions": "tiles", parameter: value})
    assert all(word in str(caught.value) for word in ('"pss_guided"', parameter, repr(value)))
