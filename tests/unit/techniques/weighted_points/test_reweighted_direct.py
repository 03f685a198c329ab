"""Many connections of the first vertex are unbiased, and more efficient in soft shadows."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.hard_cases import HARD_CASES
from tests.support.stage import film, sensor, stage
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_pixels_on_average,
    batches,
    load,
    two_halves,
)
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")


def direct(max_depth: int = 2, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "reweighted_direct", "max_depth": max_depth, **parameters})


def _box() -> mi.Scene:
    return load("cornell_box", width=32, height=32, rfilter="box")


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    mi.set_variant("llvm_ad_rgb")
    return two_halves(_box(), REFERENCE.make(3), 4096, REFERENCE_SEEDS)


@pytest.mark.parametrize("pattern, weights, count", [
    ("independent", "none", 1), ("independent", "torus", 3), ("independent", "unbiased", 5),
    ("stratified", "unbiased", 4), ("sobol", "torus", 8), ("lattice", "unbiased", 16),
])  # fmt: skip
def test_mean_agrees_with_path(reference, pattern, weights, count):
    integrator = direct(3, pattern=pattern, weights=weights, light_samples=count)
    assert_same_pixels_on_average(two_halves(_box(), integrator, 512, SEEDS), reference, 0.01)


@pytest.mark.slow
def test_glossy_things_and_mirrors_reflect_lights_once() -> None:
    """MIS weights of the BSDF sample and of the many light samples add up to one."""
    scene = load("mirrors_and_glass", width=32, height=18, rfilter="box")
    reference = two_halves(scene, REFERENCE.make(3), 6144, REFERENCE_SEEDS)
    images = two_halves(scene, direct(3, light_samples=8), 1536, SEEDS)
    assert_same_pixels_on_average(images, reference, 0.02)


@pytest.mark.parametrize("pattern, weights, factor", [
    ("independent", "unbiased", 3), ("stratified", "none", 1.3), ("stratified", "unbiased", 6),
    ("sobol", "none", 5), ("lattice", "none", 8),
])  # fmt: skip
def test_sets_lower_the_noise_of_soft_shadows(pattern, weights, factor):
    """Compared with the same number of independent light samples."""
    scene = _box()
    images = {
        name: batches(scene, direct(light_samples=64, pattern=p, weights=w), 1, [7])[0]
        for name, p, w in (
            ("exact", "sobol", "none"), ("plain", "independent", "none"), ("set", pattern, weights)
        )
    }  # fmt: skip
    # The same camera rays: what differs is the light sampling
    exact = batches(scene, direct(light_samples=4096, pattern="sobol", weights="none"), 1, [7])[0]
    plain, weighted = (np.square(images[k] - exact).mean() for k in ("plain", "set"))
    assert factor * weighted < plain


def test_light_samples_are_counted() -> None:
    scene = mi.load_dict(HARD_CASES["plain"].make())
    integrator = direct(2, light_samples=10)
    integrator.render(scene, spp=4)
    rays = integrator.statistics.rays
    assert rays["scatter"] < rays["shadow"] <= 10 * rays["camera"]
    assert rays["shadow"] > 3 * rays["camera"]


def test_camera_samples_are_counted_by_the_call_then_the_parameter_then_the_sampler() -> None:
    camera = sensor(film=film(4, 4))
    camera["sampler"] = {"type": "independent", "sample_count": 9}
    scene = mi.load_dict(stage(camera=camera))
    for parameter, spp, expected in ((0, 0, 9), (5, 0, 5), (5, 7, 7)):
        integrator = direct(camera_samples=parameter, light_samples=2)
        integrator.render(scene, spp=spp)
        assert integrator.statistics.spp == expected


def test_a_scene_names_it() -> None:
    scene = mi.load_string("""
        <scene version="3.0.0">
            <integrator type="reweighted_direct">
                <integer name="light_samples" value="12"/>
                <string name="weights" value="voronoi"/>
            </integrator>
        </scene>""")
    shown = str(scene.integrator())
    assert "count = 12" in shown and "weights = voronoi" in shown


@pytest.mark.parametrize("parameters, says", [
    ({"light_samples": -1}, "at least 0"), ({"camera_samples": -1}, "at least 0"),
    ({"pattern": "grid"}, "one of independent"), ({"light_sample": 3}, "light_sample"),
])  # fmt: skip
def test_errors_say_what_is_wrong(parameters, says):
    with pytest.raises(Exception, match=says):
        direct(**parameters)
