"""The integrators agree with Mitsuba's ``path``: in the mean, and in the image where they can."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import diffuse, film, lookat, sensor, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_image,
    assert_same_mean,
    assert_same_pixels_on_average,
    batches,
    load,
    two_halves,
)
from tests.support.technique import SCENES
from tests.support.techniques import DEFAULTS, FOLLOWERS, REFERENCE, TECHNIQUES, pairs

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 32, 18

#: The relative standard error of the image mean that z-tests reach, at most: quickly, and over many
#: seeds. The estimate of that error has a standard deviation of an eighth, and renders that learn
#: differ between machines: the limits are 1.4 times what was measured, or more. The paper's law is
#: noisy.
PRECISION = {
    "cornell_box": (0.004, 0.002),
    "door_ajar": (0.03, 0.012),
    "rooms": (0.03, 0.014),
    "mirrors_and_glass": (0.03, 0.012),
    "sunny_gloss": (0.02, 0.012),
    "window": (0.025, 0.012),
}


@functools.lru_cache(maxsize=1)
def _scene(name: str, variant: str) -> mi.Scene:
    """With a box filter, so that pixels are independent of each other. To load rooms takes longer
    than to render it, so that the scene is kept until another one is needed."""
    return load(name, width=WIDTH, height=HEIGHT, rfilter="box")


@pytest.fixture(scope="module", autouse=True)
def no_scene_is_kept_for_other_modules() -> Iterator[None]:
    yield
    _scene.cache_clear()


def _quick(column: str) -> list:
    """Parameters, one scene after the other. The small cornell_box is last: later tests have it in
    their kernels."""
    cases = [case for case in pairs(column) if case.values[-1] not in FOLLOWERS]
    return sorted(cases, key=lambda case: case.values[0], reverse=True)


# ---- The mean: other random numbers, other seeds ----


@functools.cache
def _images_of_path(scene: str, variant: str, seeds: int) -> np.ndarray:
    """Twice the usual samples, divided between ``seeds`` seeds."""
    max_depth, spp = SCENES[scene]
    integrator = REFERENCE.make(max_depth)
    return batches(_scene(scene, variant), integrator, 2 * spp // seeds, REFERENCE_SEEDS[:seeds])


def _check_mean(scene: str, name: str, variant: str = "llvm_ad_rgb", spp: int = 0) -> None:
    max_depth, default_spp = SCENES[scene]
    technique, spp = TECHNIQUES[name], spp or default_spp
    # Maps that are used everywhere make rare bright pixels, also where they do not pay
    spp *= 2 if technique.parameters.get("always_use") else 1
    seeds, test, tolerance = 2, assert_same_pixels_on_average, 0.0
    if technique.makes_splats:
        seeds, test = MANY_SEEDS, assert_same_mean
        # Colours of single wavelengths are outside of the gamut
        tolerance = 9.0 if variant == "llvm_ad_spectral" else 0.0
    kept = _scene(scene, variant)
    images = batches(kept, technique.make(max_depth), spp // seeds, SEEDS[:seeds])
    precision = PRECISION[scene][0] * (2 if "law" in technique.parameters else 1)
    test(images, _images_of_path(scene, variant, seeds), precision, tolerance=tolerance)


@pytest.mark.parametrize(("scene", "name"), _quick("scenes"))
def test_mean_agrees_with_path(scene: str, name: str) -> None:
    """This includes grids that are much too coarse or much too fine, the law of the paper,
    rejection that ignores what was learned, and other choices of lights."""
    _check_mean(scene, name)


@pytest.mark.parametrize(("variant", "name"), _quick("variants"), indirect=["variant"])
def test_mean_agrees_with_path_in_variant(variant: str, name: str) -> None:
    _check_mean("cornell_box", name, variant)


@functools.cache
def _means_of_path(scene: str) -> np.ndarray:
    max_depth, spp = SCENES[scene]
    kept = _scene(scene, "llvm_ad_rgb")
    return batches(kept, REFERENCE.make(max_depth), spp // 2, REFERENCE_SEEDS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "name"),
    # Images with splats always take many seeds
    [case for case in pairs("scenes") if not TECHNIQUES[case.values[-1]].makes_splats],
)
def test_mean_agrees_with_path_over_many_seeds(scene: str, name: str) -> None:
    max_depth, spp = SCENES[scene]
    technique = TECHNIQUES[name]
    kept = _scene(scene, "llvm_ad_rgb")
    images = batches(kept, technique.make(max_depth), spp // 2, SEEDS)
    # The paper's law is noisy, and so is a small probability for all
    factor = {"law": 2.5, "floor": 1.5}
    factors = [factor[key] for key in factor if key in technique.parameters]
    precision = PRECISION[scene][1] * max(factors, default=1)
    assert_same_mean(images, _means_of_path(scene), precision)


@pytest.mark.parametrize(
    ("name", "sampler"),
    [
        ("neepp", "sobol_owen"),
        ("pss_guided", "stratified"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("neepp", "multijitter"), ("neepp", "ldsampler"), ("pss_guided", "multijitter"),
                ("tiles", "ldsampler"),
            )
        ),
    ],
)  # fmt: skip
def test_structured_samples_over_several_passes_keep_the_mean(name: str, sampler: str) -> None:
    """Sixteen samples, cut in several passes: each pass gets samples of its own."""
    integrator = TECHNIQUES[name].make(4)
    integrator.samples_per_pass = 4
    scene = mi.load_dict(stage(camera=sensor(sampler=sampler)))
    images = batches(scene, integrator, 16, SEEDS[:6])
    assert integrator.statistics.passes >= 4
    reference = two_halves(mi.load_dict(stage()), REFERENCE.make(4), 1024, REFERENCE_SEEDS)
    assert_same_pixels_on_average(images, reference, precision=0.02)


# ---- The image: the same random numbers ----

def _assert_image_of_path(
    name: str, scene: mi.Scene, spp: int = 16, max_depth: int = 4, **parameters: Any
) -> np.ndarray:
    """One pass with the seed of ``path``."""
    image, path = (
        batches(scene, integrator.make(max_depth, **parameters), spp, [5])[0]
        for integrator in (TECHNIQUES[name], REFERENCE)
    )
    assert path.any(), "a black image proves nothing"
    assert_same_image(image, path)
    return image


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path(name: str, scene: str) -> None:
    max_depth, _ = SCENES[scene]
    _assert_image_of_path(name, load(scene, width=WIDTH, height=HEIGHT), max_depth=max_depth)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_in_variant(variant: str, name: str) -> None:
    _assert_image_of_path(name, load("cornell_box", width=WIDTH, height=HEIGHT), max_depth=6)


@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_under_early_roulette(name: str) -> None:
    """Long paths through glass: Russian roulette takes the refractive indices into account."""
    scene = load("mirrors_and_glass", width=WIDTH, height=HEIGHT)
    _assert_image_of_path(name, scene, spp=64, max_depth=12, rr_depth=2)


FILMS = {
    "gaussian": film(rfilter={"type": "gaussian"}),
    "tent": film(rfilter={"type": "tent"}),
    "mitchell": film(rfilter={"type": "mitchell"}),
    "crop": film(crop_offset_x=3, crop_offset_y=5, crop_width=7, crop_height=9),
    "sample_border": film(rfilter={"type": "gaussian"}, sample_border=True),
    "crop_with_border": film(
        rfilter={"type": "tent"}, sample_border=True,
        crop_offset_x=3, crop_offset_y=5, crop_width=7, crop_height=9,
    ),
    "alpha": film(pixel_format="rgba"),
    "luminance": film(pixel_format="luminance"),
    "compensated_half_precision": film(compensate=True, component_format="float16"),
}  # fmt: skip


@pytest.mark.parametrize("which", FILMS)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_on_film(name: str, which: str) -> None:
    image = _assert_image_of_path(name, mi.load_dict(stage(camera=sensor(film=FILMS[which]))))
    if which == "alpha":
        assert 0 < image[..., 3].mean() < 1


@pytest.mark.parametrize(
    "sampler",
    ["independent", "stratified", "multijitter", "orthogonal", "ldsampler", "sobol_owen"],
)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_with_sampler(name: str, sampler: str) -> None:
    _assert_image_of_path(name, mi.load_dict(stage(camera=sensor(sampler=sampler))))


def _sensors() -> dict[str, dict[str, Any]]:
    view = lookat([0, -4, 1.2], [0, 0, 0.6], [0, 0, 1])
    single = {"film": film(1, 1), "sampler": {"type": "independent"}}
    small = mi.ScalarTransform4f().scale([1.5, 1.5, 1])
    meter = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, -1, 0.3]).scale(0.2),
        "bsdf": diffuse(),
        "sensor": {"type": "irradiancemeter", **single},
    }
    halves = {f"view_{i}": sensor(to_world=view, fov=30.0 + i, film=film(8, 16)) for i in (0, 1)}
    return {
        "thinlens": {"camera": sensor("thinlens", aperture_radius=0.2, focus_distance=4.0)},
        "shutter": {"camera": sensor(shutter_open=0.0, shutter_close=1.0)},
        "orthographic": {"camera": sensor("orthographic", view @ small)},
        "radiancemeter": {"camera": sensor("radiancemeter", film=film(1, 1))},
        "distant": {"camera": {"type": "distant", "direction": [0, 0.5, -1], **single}},
        "irradiancemeter": {"camera": {}, "meter": meter},
        "batch": {"camera": {"type": "batch", **halves, **single, "film": film(16, 16)}},
    }


@pytest.mark.parametrize(
    "which",
    ["thinlens", "shutter", "orthographic", "radiancemeter", "distant", "irradiancemeter", "batch"],
)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_with_sensor(name: str, which: str) -> None:
    scene = stage(**_sensors()[which])
    if which == "irradiancemeter":
        del scene["sensor"]
    _assert_image_of_path(name, mi.load_dict(scene), spp=1024)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_on_spectral_film(variant: str, name: str) -> None:
    band = {"type": "irregular", "wavelengths": "400, 500, 600", "values": "0, 1, 0"}
    camera = sensor(film={"type": "specfilm", "width": 12, "height": 10, "band": band,
                          "rfilter": {"type": "box"}})  # fmt: skip
    image = _assert_image_of_path(name, mi.load_dict(stage(camera=camera)))
    assert image.shape[-1] == 1


@pytest.mark.parametrize("light", [{"type": "constant"}, None], ids=["environment", "lamp"])
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_agrees_with_path_with_hidden_emitters(name: str, light: Any) -> None:
    """Alpha included: it is 0 where the camera sees only a hidden emitter."""
    camera = sensor(film=film(pixel_format="rgba"))
    scene = mi.load_dict(stage(camera=camera, light=light, wall=None))
    image = _assert_image_of_path(name, scene, hide_emitters=True)
    assert image[..., 3].min() == 0


def test_roulette_chosen_in_composed_path_is_neepp() -> None:
    scene = load("door_ajar", width=WIDTH, height=HEIGHT)
    chosen = mi.load_dict(
        {
            "type": "composed_path", "shadow_test": "visibility_roulette",
            "next_event": "contribution", "max_depth": 6,
        }
    )
    neepp = mi.load_dict({"type": "neepp", "rejection": True, "max_depth": 6})
    images = [batches(scene, integrator, 32, [5])[0] for integrator in (chosen, neepp)]
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)
    rays = [integrator.statistics.rays["shadow"] for integrator in (chosen, neepp)]
    assert rays[0] == rays[1]


_GAMBLERS = [name for name in TECHNIQUES if TECHNIQUES[name].parameters.get("rejection")]


@pytest.mark.parametrize("name", [
    name if name in ("rejecting", "mapped_floor") else pytest.param(name, marks=pytest.mark.slow)
    for name in _GAMBLERS
])  # fmt: skip
def test_roulette_rejects_shadow_rays_where_most_are_blocked(name: str) -> None:
    """If it did not, the tests of the mean would prove nothing."""
    scene = load("door_ajar", width=WIDTH, height=HEIGHT)
    rays = []
    for technique in (TECHNIQUES["composed_path"], TECHNIQUES[name]):
        integrator = technique.make(6)
        batches(scene, integrator, 128, [5])
        rays.append(integrator.statistics.rays["shadow"])
    assert rays[1] < 0.8 * rays[0], rays


# ---- Output variables, and integrators that nest ours ----

AOVS = "depth:depth,normal:sh_normal,albedo:albedo"


@pytest.mark.parametrize("name", FOLLOWERS)
def test_output_variables_agree_with_mitsuba(name: str) -> None:
    scene = mi.load_dict(stage())
    path = {"type": "path", "max_depth": 4}
    aov = mi.load_dict({"type": "aov", "aovs": AOVS, "image": path})
    own = TECHNIQUES[name].make(4, aovs=AOVS)
    images = [batches(scene, integrator, 16, [5])[0] for integrator in (own, aov)]
    assert images[0].shape[-1] == 3 + 1 + 3 + 3
    assert_same_image(*images)
    for channel in range(images[0].shape[-1]):
        assert_same_image(*(image[..., channel] for image in images))


#: Others do not go through ``sample()``.
_NESTED = [name for name in DEFAULTS if not TECHNIQUES[name].makes_splats]


@pytest.mark.parametrize("name", _NESTED)
def test_aov_shows_the_image_of_the_nested_integrator(name: str) -> None:
    scene, inner = mi.load_dict(stage()), TECHNIQUES[name].make(4)
    aov = mi.load_dict({"type": "aov", "aovs": AOVS, "image": inner})
    images = [batches(scene, integrator, 16, [5])[0] for integrator in (aov, inner)]
    assert_same_image(images[0][..., :3], images[1])


@pytest.mark.parametrize("name", _NESTED)
def test_moment_sees_single_samples(name: str) -> None:
    """Nothing is learned there, so the image agrees with ``path``."""
    scene = mi.load_dict(stage())
    images = [
        batches(scene, mi.load_dict({"type": "moment", "image": inner.make(4)}), 16, [5])[0]
        for inner in (TECHNIQUES[name], REFERENCE)
    ]
    assert images[0].shape[-1] > 3
    assert_same_image(*images)


def test_output_variables_have_names() -> None:
    integrator = TECHNIQUES["composed_path"].make(4, aovs="depth:depth,nn:sh_normal")
    assert integrator.aov_names() == ["depth.T", "nn.X", "nn.Y", "nn.Z"]
