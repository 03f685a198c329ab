"""Weighted points of the aperture are unbiased, come in whole sets, and lower the noise of
defocus."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import area, diffuse, film, lookat, sensor, stage
from tests.support.statistical import (
    assert_images_are_sound,
    assert_same_pixels_on_average,
    batches,
)

pytestmark = pytest.mark.usefixtures("variant")

PATH = {"type": "path", "max_depth": 3}


def lens(nested: dict | None = PATH, **parameters: Any) -> mi.Integrator:
    children = {"nested": nested} if nested else {}
    return mi.load_dict({"type": "reweighted_lens", **parameters, **children})


def thin_lens(**parameters: Any) -> dict[str, Any]:
    view = lookat([0, -4, 0], [0, 0, 0], [0, 0, 1])
    optics = {"aperture_radius": 0.4, "focus_distance": 2.5}
    return sensor("thinlens", to_world=view, **optics, **parameters)


def bokeh(**parameters: Any) -> mi.Scene:
    """Small lamps far out of focus: all noise comes from the lens."""
    lamps = {
        f"lamp_{i}": {
            "type": "sphere", "center": [x, 0, z], "radius": 0.2, "emitter": area(5.0 + i),
        }
        for i, (x, z) in enumerate([(-0.8, 0.5), (0.1, -0.3), (0.7, 0.6), (0.5, -0.8)])
    }  # fmt: skip
    return mi.load_dict({"type": "scene", "sensor": thin_lens(**parameters), **lamps})


# ---- The mean ----


#: Over borders that a filter needs.
WIDE = film(96, 96, rfilter={"type": "gaussian"}, sample_border=True)


@functools.cache
def _reference() -> np.ndarray:
    return batches(bokeh(film=WIDE), mi.load_dict(PATH), 128, [1001, 1002])


@pytest.mark.parametrize("pattern, weights", [
    ("independent", "none"), ("independent", "torus"), ("independent", "unbiased"),
    ("stratified", "unbiased"), ("sobol", "torus"), ("lattice", "none"), ("halton", "unbiased"),
])  # fmt: skip
def test_mean_agrees_with_the_nested_integrator(pattern, weights):
    """With few samples, where weights differ most."""
    images = batches(bokeh(film=WIDE), lens(pattern=pattern, weights=weights), 7, [1, 2])
    assert_same_pixels_on_average(images, _reference(), 0.02, tile=24, unit=4)


@pytest.mark.parametrize("nested", [
    {"type": "volpath", "max_depth": 4},
    {"type": "neepp", "max_depth": 4},
    {"type": "composed_path", "max_depth": 4, "hide_emitters": True},
    pytest.param({"type": "pss_guided", "max_depth": 4}, marks=pytest.mark.slow),
], ids=lambda nested: nested["type"])  # fmt: skip
def test_mean_with_other_integrators(nested):
    camera = thin_lens(film=film(16, 16))
    wall = {"type": "rectangle", "bsdf": diffuse(0.5),
            "to_world": lookat([0, 1, 0], [0, 0, 0], [0, 0, 1]).scale(3)}  # fmt: skip
    scene = mi.load_dict(stage(camera=camera, back=wall))
    reference = batches(scene, mi.load_dict(nested), 384, [1001, 1002])
    assert_same_pixels_on_average(batches(scene, lens(nested), 384, [1, 2]), reference, 0.05)


# ---- Sets ----

WHITE = {"type": "constant", "radiance": 1.0}


@pytest.mark.parametrize("weights", ["voronoi", "torus", "unbiased"])
def test_a_constant_has_no_noise(weights):
    """The weights of each pixel add up to one, also of several sets."""
    scene = mi.load_dict(
        {"type": "scene", "sensor": thin_lens(film=film(5, 3)), "light": WHITE}
    )
    for spp in (1, 2, 64, 1500):
        (image,) = batches(scene, lens(weights=weights, pattern="independent"), spp, [1])
        np.testing.assert_allclose(image, 1, rtol=1e-4)


@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter", "ldsampler"])
def test_a_timeout_and_passes_keep_sets_whole(sampler):
    camera = thin_lens(film=film(5, 3), sampler=sampler)
    scene = mi.load_dict({"type": "scene", "sensor": camera, "light": WHITE})
    integrator = lens(pattern="independent", weights="torus", timeout=0.02)
    integrator.samples_per_pass = 10
    (image,) = batches(scene, integrator, 1600, [1])
    assert integrator.statistics.spp < 1600 and integrator.statistics.spp % 64 == 0
    np.testing.assert_allclose(image, 1, rtol=1e-4)
    integrator = lens(pattern="independent", weights="torus")
    integrator.samples_per_pass = 40
    (image,) = batches(scene, integrator, 256, [1])
    np.testing.assert_allclose(image, 1, rtol=1e-4)


# ---- Variance ----


@pytest.mark.parametrize("pattern, weights, factor", [
    ("independent", "unbiased", 1.2), ("stratified", "none", 1.5), ("stratified", "unbiased", 1.5),
    ("sobol", "none", 2), ("lattice", "none", 2),
])  # fmt: skip
def test_sets_lower_the_noise_of_defocus(pattern, weights, factor):
    scene = bokeh(film=film(64, 64))
    plain = batches(scene, mi.load_dict(PATH), 64, range(1, 4)).var(axis=0).mean()
    images = batches(scene, lens(pattern=pattern, weights=weights), 64, range(1, 4))
    weighted = images.var(axis=0).mean()
    assert factor * weighted < plain, f"{plain / weighted:.2f} times less noise"


def test_seeds_are_independent_and_repeatable() -> None:
    scene = bokeh(film=film(16, 16))
    a, b, other = batches(scene, lens(), 16, [1, 1, 2])
    np.testing.assert_allclose(a, b, rtol=1e-5)
    assert_images_are_sound(np.stack([a, other]))
    assert np.abs(a - other).mean() > 0.01 * a.mean()


# ---- Scene files, warnings and errors ----


def test_without_an_aperture_the_nested_integrator_goes_on_alone() -> None:
    scene = mi.load_dict(stage(camera=sensor(film=film(9, 7))))
    image, same = (batches(scene, i, 16, [3])[0] for i in (lens(), mi.load_dict(PATH)))
    np.testing.assert_allclose(image, same, rtol=1e-4, atol=1e-5)


def test_a_scene_names_it() -> None:
    scene = mi.load_string("""
        <scene version="3.0.0">
            <integrator type="reweighted_lens">
                <string name="pattern" value="sobol"/>
                <string name="weights" value="torus"/>
                <integrator type="path"><integer name="max_depth" value="2"/></integrator>
            </integrator>
        </scene>""")
    shown = str(scene.integrator())
    assert "pattern = sobol" in shown and "weights = torus" in shown and "PathIntegrator" in shown


@pytest.mark.parametrize("make, says", [
    (lambda: lens(None), "exactly one"), (lambda: lens(other=PATH), "exactly one"),
    (lambda: lens({"type": "prb"}), "none for gradients"),
    (lambda: lens({"type": "ptracer"}), "samples camera rays"),
    (lambda: lens(pattern="sobel"), "one of independent"),
    (lambda: lens(weights="area"), "one of none"), (lambda: lens(patern="sobol"), "patern"),
])  # fmt: skip
def test_errors_say_what_is_wrong(make, says):
    with pytest.raises(Exception, match=says):
        make()
