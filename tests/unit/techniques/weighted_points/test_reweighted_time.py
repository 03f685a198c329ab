"""Weighted times of the shutter interval are unbiased, and lower the noise of motion."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import film, lookat, sensor, stage
from tests.support.statistical import (
    assert_images_are_sound,
    assert_same_pixels_on_average,
    batches,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")

PATH = {"type": "composed_path", "max_depth": 3}


def timed(nested: dict | None = PATH, **parameters: Any) -> mi.Integrator:
    children = {"nested": nested} if nested else {}
    return mi.load_dict({"type": "reweighted_time", **parameters, **children})


def camera(kind: str = "perspective", **parameters: Any) -> dict[str, Any]:
    view = lookat([0, -4, 0], [0, 0, 0], [0, 0, 1])
    return sensor(kind, to_world=view, shutter_open=0.25, shutter_close=0.75, **parameters)


def streaks(**parameters: Any) -> mi.Scene:
    """Black balls that fly before a bright sky: all noise comes from the time."""
    black = {"type": "diffuse", "reflectance": 0.0}
    balls = {
        f"ball_{i}": {
            "type": "moving", "translate": [4.0, 0, z],
            "ball": {"type": "sphere", "center": [-2, i - 1, -z / 2], "radius": 0.4, "bsdf": black},
        }
        for i, z in enumerate([-1.5, 0.4, 2.0])
    }  # fmt: skip
    sky = {"type": "constant", "radiance": 1.0}
    return mi.load_dict({"type": "scene", "sensor": camera(**parameters), "sky": sky, **balls})


@functools.cache
def _reference() -> np.ndarray:
    return batches(streaks(film=film(64, 64)), mi.load_dict(PATH), 128, [1001, 1002])


@pytest.mark.parametrize("pattern, weights", [
    ("independent", "none"), ("independent", "torus"), ("independent", "unbiased"),
    ("stratified", "unbiased"), ("sobol", "torus"), ("lattice", "none"),
])  # fmt: skip
def test_mean_agrees_with_the_nested_integrator(pattern, weights):
    """With few samples, where weights differ most."""
    assert 0.3 < _reference().mean() < 0.95
    images = batches(streaks(film=film(64, 64)), timed(pattern=pattern, weights=weights), 7, [1, 2])
    assert_same_pixels_on_average(images, _reference(), 0.01)


@pytest.mark.parametrize("weights", ["voronoi", "torus", "unbiased"])
def test_a_constant_has_no_noise(weights):
    sky = {"type": "constant", "radiance": 1.0}
    scene = mi.load_dict({"type": "scene", "sensor": camera(film=film(5, 3)), "light": sky})
    for spp in (1, 7, 1500):
        (image,) = batches(scene, timed(weights=weights, pattern="independent"), spp, [1])
        np.testing.assert_allclose(image, 1, rtol=1e-4)


@pytest.mark.parametrize("pattern, weights, factor", [
    ("independent", "unbiased", 3), ("stratified", "none", 5), ("sobol", "none", 8),
    ("lattice", "none", 8),
])  # fmt: skip
def test_sets_lower_the_noise_of_motion(pattern, weights, factor):
    scene = streaks(film=film(32, 32))
    plain = batches(scene, mi.load_dict(PATH), 64, range(1, 4)).var(axis=0).mean()
    integrator = timed(pattern=pattern, weights=weights)
    weighted = batches(scene, integrator, 64, range(1, 4)).var(axis=0).mean()
    assert factor * weighted < plain, f"{plain / weighted:.2f} times less noise"


@pytest.mark.parametrize(
    "nested", some("reweighted_direct", of=["neepp", "pss_guided", "reweighted_direct"])
)
def test_mean_with_other_integrators(nested):
    ball = {"type": "moving", "translate": [0.8, 0, 0.4], "ball": {"type": "sphere", "radius": 0.5}}
    scene = mi.load_dict(stage(camera=camera(film=film(12, 12)), ball=ball))
    nested = {"type": nested, "max_depth": 4}
    reference = batches(scene, mi.load_dict(nested), 256, [1001, 1002])
    assert_same_pixels_on_average(batches(scene, timed(nested), 256, [1, 2]), reference, 0.05)


@pytest.mark.slow
def test_lens_and_time_work_together() -> None:
    """Nested in each other: the mean stays, and both kinds of noise fall."""
    scene = streaks(kind="thinlens", film=film(24, 24), aperture_radius=0.3, focus_distance=2.0)
    lens = {"type": "reweighted_lens", "nested": PATH}
    nested = {"path": PATH, "time": {"type": "reweighted_time", "nested": PATH}, "lens": lens,
              "both": {"type": "reweighted_time", "nested": lens}}  # fmt: skip
    images = {
        name: batches(scene, mi.load_dict(integrator), 64, range(1, 6))
        for name, integrator in nested.items()
    }
    assert_same_pixels_on_average(images["both"], images["path"], 0.03)
    noise = {name: image.var(axis=0).mean() for name, image in images.items()}
    assert noise["both"] < min(0.5 * noise["lens"], noise["time"])


def test_seeds_are_independent_and_repeatable() -> None:
    scene = streaks(film=film(16, 16))
    a, b, other = batches(scene, timed(), 16, [1, 1, 2])
    np.testing.assert_allclose(a, b, rtol=1e-5)
    assert_images_are_sound(np.stack([a, other]))
    assert np.abs(a - other).mean() > 0.001 * a.mean()


def test_without_an_open_shutter_the_nested_integrator_goes_on_alone() -> None:
    scene = mi.load_dict(stage(camera=sensor(film=film(9, 7))))
    image, same = (batches(scene, i, 16, [3])[0] for i in (timed(), mi.load_dict(PATH)))
    np.testing.assert_allclose(image, same, rtol=1e-4, atol=1e-5)


def test_integrators_of_mitsuba_are_refused_where_shapes_move() -> None:
    with pytest.raises(NotImplementedError, match="composed_path"):
        timed({"type": "path"}).render(streaks(film=film(4, 4)), spp=1)


def test_a_scene_names_it() -> None:
    scene = mi.load_string("""
        <scene version="3.0.0">
            <integrator type="reweighted_time">
                <string name="pattern" value="sobol"/>
                <string name="weights" value="unbiased"/>
                <integrator type="neepp"><integer name="max_depth" value="2"/></integrator>
            </integrator>
        </scene>""")
    shown = str(scene.integrator())
    assert "pattern = sobol" in shown and "weights = unbiased" in shown and "neepp[" in shown


@pytest.mark.parametrize("make, says", [
    (lambda: timed(None), "exactly one"),
    (lambda: timed({"type": "reweighted_time", "nested": PATH}), "exactly one"),
    (lambda: timed(weights="area"), "one of none"), (lambda: timed(patern="sobol"), "patern"),
])  # fmt: skip
def test_errors_say_what_is_wrong(make, says):
    with pytest.raises(Exception, match=says):
        make()
