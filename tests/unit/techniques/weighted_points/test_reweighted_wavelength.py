"""Weighted wavelengths are unbiased, and lower the coloured noise."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import film, lookat, sensor, stage
from tests.support.statistical import assert_same_pixels_on_average, batches

pytestmark = pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)

PATH = {"type": "path", "max_depth": 3}
OURS = {"type": "composed_path", "max_depth": 8}


def coloured(nested: dict | None = PATH, **parameters: Any) -> mi.Integrator:
    children = {"nested": nested} if nested else {}
    return mi.load_dict({"type": "reweighted_wavelength", **parameters, **children})


def grey_sky(size: int = 16, **parameters: Any) -> mi.Scene:
    """All noise comes from the wavelengths."""
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    camera = sensor(film=film(size, size, **parameters))
    return mi.load_dict({"type": "scene", "sensor": camera, "sky": sky})


def marble(size: int = 16) -> mi.Scene:
    """A ball of flint glass before a sky that is half dark."""
    sky = np.zeros((16, 32, 3), np.float32)
    sky[:, ::4] = 1
    return mi.load_dict({
        "type": "scene",
        "sensor": sensor(to_world=lookat([0, -3, 0], [0, 0, 0], [0, 0, 1]), fov=36.0,
                         film=film(size, size)),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
        "ball": {"type": "sphere", "bsdf": {"type": "dispersive_dielectric", "int_ior": "sf10"}},
    })  # fmt: skip


SCENES = {"grey_sky": (grey_sky, PATH), "marble": (marble, OURS)}


@functools.cache
def _reference(scene: str) -> np.ndarray:
    make, nested = SCENES[scene]
    return batches(make(64), mi.load_dict(nested), 96, [1001, 1002])


@pytest.mark.parametrize("pattern, weights", [
    ("independent", "none"), ("independent", "torus"), ("stratified", "torus"),
    ("lattice", "torus"), ("lattice", "none"), ("sobol", "none"),
])  # fmt: skip
@pytest.mark.parametrize("scene", SCENES)
def test_mean_agrees_with_the_nested_integrator(variant, scene, pattern, weights):
    """With few samples, where weights differ most; with and without dispersion."""
    make, nested = SCENES[scene]
    images = batches(make(64), coloured(nested, pattern=pattern, weights=weights), 7, [1, 2])
    assert_same_pixels_on_average(images, _reference(scene), 0.03, tile=16, tolerance=9)


@pytest.mark.parametrize("pattern", ["independent", "lattice"])
def test_weights_of_all_four_add_up_to_one(variant, pattern):
    scene = grey_sky(pixel_format="rgba")
    for spp in (1, 3, 64, 1500):
        (image,) = batches(scene, coloured(weights="torus", pattern=pattern), spp, [1])
        np.testing.assert_allclose(image[..., 3], 1, rtol=1e-4)


@pytest.mark.parametrize("scene, pattern, weights, factor", [
    ("grey_sky", "independent", "torus", 8), ("grey_sky", "stratified", "torus", 8),
    ("grey_sky", "stratified", "none", 8), ("grey_sky", "lattice", "none", 8),
    ("marble", "stratified", "none", 2), ("marble", "lattice", "none", 2),
    ("marble", "lattice", "torus", 2),
])  # fmt: skip
def test_sets_lower_the_noise_of_colours(variant, scene, pattern, weights, factor):
    make, nested = SCENES[scene]
    scene = make(32)
    plain = batches(scene, mi.load_dict(nested), 64, range(1, 4)).var(axis=0).mean()
    integrator = coloured(nested, pattern=pattern, weights=weights)
    weighted = batches(scene, integrator, 64, range(1, 4)).var(axis=0).mean()
    assert factor * weighted < plain, f"{plain / weighted:.2f} times less noise"


def test_a_single_wavelength_has_the_weight_of_the_whole_circle(variant) -> None:
    """Behind a plate of glass every path is refracted, but hardly bent: cells modulo 1/4 would
    leave the noise of independent numbers."""
    spectrum = {"type": "irregular", "wavelengths": "400, 550, 700", "values": "0, 1, 0"}
    sides = {
        f"side_{y}": {
            "type": "rectangle", "to_world": lookat([0, y, 0], [0, 9 * y, 0], [0, 0, 1]).scale(9),
            "bsdf": {"type": "dispersive_dielectric", "cauchy": "1.0003, 0.0001", "ext_ior": 1.0},
        }
        for y in (-1, 1)
    }  # fmt: skip
    scene = mi.load_dict({
        "type": "scene", "sky": {"type": "constant", "radiance": spectrum}, **sides,
        "sensor": sensor(to_world=lookat([0, -4, 0], [0, 0, 0], [0, 0, 1]), film=film(16, 16)),
    })  # fmt: skip
    plain = batches(scene, mi.load_dict(OURS), 64, range(1, 6)).var(axis=0).mean()
    weighted = coloured(OURS, pattern="independent", weights="torus")
    assert 5 * batches(scene, weighted, 64, range(1, 6)).var(axis=0).mean() < plain


@pytest.mark.slow
@pytest.mark.parametrize("nested", ["neepp", "pss_guided"])
def test_mean_with_other_integrators(variant, nested):
    scene = mi.load_dict(stage(camera=sensor(film=film(12, 12))))
    nested = {"type": nested, "max_depth": 4}
    reference = batches(scene, mi.load_dict(nested), 384, [1001, 1002])
    assert_same_pixels_on_average(batches(scene, coloured(nested), 384, [1, 2]), reference, 0.05)


def test_a_scene_names_it(variant) -> None:
    scene = mi.load_string("""
        <scene version="3.0.0">
            <integrator type="reweighted_wavelength">
                <string name="pattern" value="sobol"/>
                <string name="weights" value="torus"/>
                <integrator type="path"><integer name="max_depth" value="2"/></integrator>
            </integrator>
        </scene>""")
    shown = str(scene.integrator())
    assert "pattern = sobol" in shown and "weights = torus" in shown and "PathIntegrator" in shown


def test_variants_without_wavelengths_are_refused(variant) -> None:
    mi.set_variant("llvm_ad_rgb")
    with pytest.raises(Exception, match="llvm_ad_spectral"):
        coloured()


@pytest.mark.parametrize("make, says", [
    (lambda: coloured(None), "exactly one"), (lambda: coloured(weights="unbiased"), "one of none"),
    (lambda: coloured(patern="sobol"), "patern"),
])  # fmt: skip
def test_errors_say_what_is_wrong(variant, make, says):
    with pytest.raises(Exception, match=says):
        make()
