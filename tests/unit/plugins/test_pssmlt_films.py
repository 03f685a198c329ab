"""``pssmlt`` renders what ``path`` renders: films, sensors, motion, dispersive glass."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.chain_integrators import ALONE, pssmlt
from tests.support.emitters_and_materials import T, below_the_lamp
from tests.support.stage import area, diffuse, film, rectangle, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_same_quarters,
    batches,
    some,
    z_exact,
)
from tests.support.techniques import TECHNIQUES

pytestmark = pytest.mark.usefixtures("variant")


def composed(max_depth: int = 4, **parameters: Any) -> Any:
    return TECHNIQUES["composed_path"].make(max_depth, **parameters)


# ---- Films ----

FILMS = {
    "tent": {"rfilter": {"type": "tent"}},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "lanczos": {"rfilter": {"type": "lanczos"}},
    "box, cropped": {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 7, "crop_height": 9},
    "mitchell, cropped": {"rfilter": {"type": "mitchell"}, "crop_offset_x": 3, "crop_offset_y": 5,
                          "crop_width": 7, "crop_height": 9},
    "luminance": {"rfilter": {"type": "gaussian"}, "pixel_format": "luminance"},
    "alpha, compensated": {"rfilter": {"type": "gaussian"}, "pixel_format": "rgba",
                           "compensate": True, "component_format": "float16"},
    "odd": {"width": 13, "height": 7},
    "one pixel": {"width": 1, "height": 1},
}  # fmt: skip


@pytest.mark.parametrize("name", some("gaussian", "alpha, compensated", of=FILMS))
def test_every_pixel_has_its_light_up_to_the_edges(name: str) -> None:
    """Before a sky of radiance 1, with few camera samples: they only choose what the film divides
    by."""
    size = {"width": 16, "height": 16, **FILMS[name]}
    scene = mi.load_dict({"type": "scene", "sensor": sensor(film=film(**size)),
                          "sky": {"type": "constant"}})  # fmt: skip
    spp = 1 << 14 if name == "one pixel" else 256
    images = batches(scene, pssmlt(**ALONE), spp, SEEDS)
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0)
    assert abs(z) < THRESHOLD and error < 0.002, (z, error)
    for edge in (np.s_[:, :1], np.s_[:, -1:], np.s_[:, :, :1], np.s_[:, :, -1:]):
        z, error = z_exact(images[edge].mean(axis=(1, 2, 3)), 1.0)
        assert abs(z) < THRESHOLD + 0.4 and error < 0.02, (z, error)


@pytest.mark.parametrize("direct", some(-1, of=[-1, 16]))
def test_alpha_and_output_variables_come_from_the_camera_samples(direct: int) -> None:
    aovs = "depth:depth,normal:sh_normal"
    camera = sensor(film=film(pixel_format="rgba", rfilter={"type": "gaussian"}))
    scene = mi.load_dict(stage(camera=camera, wall=None))
    with_aovs, without, path = (
        batches(scene, integrator, 16, [5])[0]
        for integrator in (
            pssmlt(direct_samples=direct, aovs=aovs), pssmlt(direct_samples=direct),
            composed(aovs=aovs),
        )
    )  # fmt: skip
    assert with_aovs.shape[-1] == 4 + 1 + 3 and 0 < path[..., 3].mean() < 1
    np.testing.assert_allclose(with_aovs[..., :4], without, rtol=1e-4, atol=1e-5 * without.mean())
    np.testing.assert_allclose(with_aovs[..., 3:], path[..., 3:], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"], indirect=True)
def test_a_film_that_takes_no_light_of_chains_is_refused(variant: str) -> None:
    refused = film(rfilter={"type": "gaussian"}, sample_border=True)
    if variant == "llvm_ad_spectral":
        band = {"type": "irregular", "wavelengths": "400, 500, 600", "values": "0, 1, 0"}
        refused = {"type": "specfilm", "width": 4, "height": 4, "band": band}
    scene = mi.load_dict(stage(camera=sensor(film=refused)))
    with pytest.raises(NotImplementedError, match='"pssmlt": light .*(border|SpecFilm)'):
        pssmlt().render(scene, spp=1)


# ---- Sensors, motion, materials ----

_SENSORS = {
    "shutter": {"shutter_open": 0.0, "shutter_close": 1.0},
    "principal point": {"principal_point_offset_x": 0.2},
}


def _assert_mean_of_path(
    scene: mi.Scene, max_depth: int, spp: int, precision: float, **parameters: Any
) -> None:
    """In quarters. Each lane has few mutations, but no two seeds have a sample in common."""
    integrator = pssmlt(max_depth, chains=1024, **parameters)
    images = batches(scene, integrator, spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, composed(max_depth), 4 * spp, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision)


@pytest.mark.slow
@pytest.mark.parametrize("which", _SENSORS)
def test_a_sensor_sees_what_it_sees_with_path(which: str) -> None:
    camera = below_the_lamp(**_SENSORS[which])
    scene = mi.load_dict(stage(camera=camera), optimize=False)
    _assert_mean_of_path(scene, 4, 256, 0.01, **ALONE)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", ["orthographic", "radiancemeter"])
def test_sensors_that_light_paths_cannot_reach_are_no_obstacle(plugin: str) -> None:
    size = {"film": film(1, 1)} if plugin == "radiancemeter" else {}
    scene = mi.load_dict(stage(camera=sensor(plugin, **size)), optimize=False)
    spp = 1 << 15 if size else 256
    _assert_mean_of_path(scene, 4, spp, 0.02, **ALONE)


@pytest.mark.slow
@pytest.mark.parametrize("direct", [-1, 256])
def test_moving_shapes_are_blurred_as_by_the_path_tracer(direct: int) -> None:
    cube = {"type": "cube", "to_world": T().translate([0.5, 0, 0.4]).scale([0.3, 0.3, 0.4]),
            "bsdf": diffuse(0.3, 0.6, 0.3)}  # fmt: skip
    block = {"type": "moving", "axis": [1.0, 2.0, 0.5], "angle": 200.0,
             "translate": [0.3, 0.0, 0.1], "child": cube}  # fmt: skip
    camera = below_the_lamp("thinlens", aperture_radius=0.1, focus_distance=4.0,
                            shutter_open=0.25, shutter_close=0.75)  # fmt: skip
    scene = mi.load_dict(stage(camera=camera, block=block), optimize=False)
    _assert_mean_of_path(scene, 4, 256, 0.01, direct_samples=direct)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_dispersive_glass_agrees_with_the_path_tracer(variant: str) -> None:
    """Each channel: a hero wavelength that goes astray would colour the image."""
    lamp = rectangle(T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180), emitter=area(5.0),
                     bsdf=diffuse(0.0))  # fmt: skip
    ball = {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.5,
            "bsdf": {"type": "dispersive_dielectric", "int_ior": "sf10"}}  # fmt: skip
    scene = mi.load_dict(stage(light=lamp, block=ball), optimize=False)
    images = batches(scene, pssmlt(6, **ALONE, chains=1024), 512, SEEDS[:MANY_SEEDS])
    expected = batches(scene, composed(6), 2048, REFERENCE_SEEDS[:MANY_SEEDS])
    for channel in range(3):
        parts = (x[..., channel : channel + 1] for x in (images, expected))
        assert_same_quarters(*parts, 0.02)
