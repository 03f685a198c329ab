"""The integrators agree with Mitsuba's ``path``: in the mean, and in the image where they can."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from hard_cases import diffuse, film, lookat, sensor, stage
from statistical import (
    REFERENCE,
    REFERENCE_SEEDS,
    SEEDS,
    UNDER_TEST,
    UNUSUAL,
    assert_same_image,
    assert_same_mean,
    batches,
    load,
)

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 32, 18

#: Scene, max_depth, samples per pixel, and the relative standard error to be reached. Heavy tails
#: (a small sun through glass, caustics) are tested with short paths.
SCENES: dict[str, tuple[str, int, int, float]] = {
    "cornell_box": ("cornell_box", 6, 256, 0.002),
    "door_ajar": ("door_ajar", 6, 128, 0.01),
    "rooms": ("rooms", 4, 128, 0.015),
    "mirrors_and_glass": ("mirrors_and_glass", 3, 128, 0.015),
    "sunny_gloss": ("sunny_gloss", 2, 128, 0.012),
    "window": ("window", 3, 64, 0.012),
}


@functools.cache
def _images(scene: str, name: str, variant: str) -> np.ndarray:
    """Of an integrator under test, an unusual one, or ``path``, which has the most seeds: it costs
    least, and all are compared with it."""
    file, max_depth, spp, _ = SCENES[scene]
    seeds = {"path": REFERENCE_SEEDS, **dict.fromkeys(UNUSUAL, SEEDS[:8])}.get(name, SEEDS[:10])
    integrator = {"path": REFERENCE, **UNDER_TEST, **UNUSUAL}[name].make(max_depth)
    return batches(load(file, width=WIDTH, height=HEIGHT), integrator, spp, seeds)


def _check_mean(scene: str, name: str, variant: str = "llvm_ad_rgb", precision: float = 0) -> None:
    images = [_images(scene, n, variant) for n in (name, "path")]
    assert_same_mean(*images, precision=precision or SCENES[scene][3])


# ---- The mean: other random numbers, other seeds ----


#: Those that draw the numbers of ``path`` are compared image by image, which is sharper.
_MEAN_CASES = [
    (scene, name)
    for scene in SCENES
    for name, under_test in UNDER_TEST.items()
    if scene == "cornell_box" or not under_test.draws_like_path
]


@pytest.mark.parametrize(("scene", "name"), _MEAN_CASES)
def test_mean_is_that_of_path(scene: str, name: str) -> None:
    _check_mean(scene, name)


#: The paper's law is so noisy that its mean is known well enough in one scene only. Skies are
#: divided, and their directions rejected, where light sampling is learned.
_UNUSUAL_CASES = [
    *(("door_ajar" if "paper" in name else "rooms", name) for name in UNUSUAL),
    *(("window", name) for name in ("visibility", "grid_64", "rejecting_floor")),
]


@pytest.mark.parametrize(("scene", "name"), _UNUSUAL_CASES)
def test_mean_is_that_of_path_with_unusual_parameters(scene: str, name: str) -> None:
    """Grids that are far too coarse and far too fine, the paper's law, rejection without regard to
    what was learned, lights that are chosen in other ways."""
    _check_mean(scene, name, precision=0.03)


IN_VARIANTS = pytest.mark.parametrize(
    ("variant", "scene"),
    [("llvm_ad_mono", "cornell_box"), ("llvm_ad_spectral", "cornell_box")],
    indirect=["variant"],
)


@pytest.mark.parametrize(
    "name", [name for name, under_test in UNDER_TEST.items() if not under_test.draws_like_path]
)
@IN_VARIANTS
def test_mean_is_that_of_path_in_variant(variant: str, scene: str, name: str) -> None:
    _check_mean(scene, name, variant, precision=0.012)


@pytest.mark.parametrize(
    ("name", "sampler"),
    [("neepp", "multijitter"), ("neepp", "ldsampler"), ("pss_guided", "multijitter"),
     ("pss_guided", "stratified"), ("tiles", "ldsampler")],
)  # fmt: skip
def test_structured_samples_over_several_passes_keep_the_mean(
    name: str, sampler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixteen samples, cut in several passes: each pass gets samples of its own."""
    from mitsuba_ext import rendering

    monkeypatch.setattr(rendering, "_PASS_SAMPLES", dict.fromkeys(rendering._PASS_SAMPLES, 1024))
    monkeypatch.setattr(rendering, "_PASS_SPP", 1)
    integrator = {**UNDER_TEST, **UNUSUAL}[name].make(4)
    scene = mi.load_dict(stage(camera=sensor(sampler=sampler)))
    images = batches(scene, integrator, 16, SEEDS)
    assert integrator.statistics.passes >= 4
    scene = mi.load_dict(stage())
    reference = batches(scene, REFERENCE.make(4), 64, REFERENCE_SEEDS)
    assert_same_mean(images, reference, precision=0.02)


# ---- The image: the same random numbers ----

FOLLOWERS = [name for name, under_test in UNDER_TEST.items() if under_test.draws_like_path]


def _assert_image_of_path(
    name: str, scene: mi.Scene, spp: int = 16, max_depth: int = 4, **parameters: Any
) -> np.ndarray:
    """One pass with the seed of ``path``."""
    image, path = (
        batches(scene, integrator.make(max_depth, **parameters), spp, [5])[0]
        for integrator in (UNDER_TEST[name], REFERENCE)
    )
    assert path.any(), "a black image proves nothing"
    assert_same_image(image, path)
    return image


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path(name: str, scene: str) -> None:
    scene, max_depth, _, _ = SCENES[scene]
    _assert_image_of_path(name, load(scene, width=WIDTH, height=HEIGHT), max_depth=max_depth)


@IN_VARIANTS
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path_in_variant(variant: str, scene: str, name: str) -> None:
    _assert_image_of_path(name, load(scene, width=WIDTH, height=HEIGHT), max_depth=6)


@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path_under_early_roulette(name: str) -> None:
    """Long paths through glass: the roulette knows the indices of refraction."""
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
def test_image_is_that_of_path_on_film(name: str, which: str) -> None:
    image = _assert_image_of_path(name, mi.load_dict(stage(camera=sensor(film=FILMS[which]))))
    if which == "alpha":
        assert 0 < image[..., 3].mean() < 1


@pytest.mark.parametrize(
    "sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"]
)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path_with_sampler(name: str, sampler: str) -> None:
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
def test_image_is_that_of_path_with_sensor(name: str, which: str) -> None:
    scene = stage(**_sensors()[which])
    if which == "irradiancemeter":
        del scene["sensor"]
    _assert_image_of_path(name, mi.load_dict(scene), spp=1024)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path_on_spectral_film(variant: str, name: str) -> None:
    band = {"type": "irregular", "wavelengths": "400, 500, 600", "values": "0, 1, 0"}
    camera = sensor(film={"type": "specfilm", "width": 12, "height": 10, "band": band,
                          "rfilter": {"type": "box"}})  # fmt: skip
    image = _assert_image_of_path(name, mi.load_dict(stage(camera=camera)))
    assert image.shape[-1] == 1


@pytest.mark.parametrize("light", [{"type": "constant"}, None], ids=["environment", "lamp"])
@pytest.mark.parametrize("name", FOLLOWERS)
def test_image_is_that_of_path_with_hidden_emitters(name: str, light: Any) -> None:
    """Alpha included: where nothing but an emitter is, there is nothing."""
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


def test_roulette_rejects_shadow_rays_where_most_are_blocked() -> None:
    """Otherwise the tests of its mean would test nothing."""
    scene = load("door_ajar", width=WIDTH, height=HEIGHT)
    rays = {}
    gamblers = [name for name in UNUSUAL if UNUSUAL[name].parameters.get("rejection")]
    for name in ("composed_path", *gamblers):
        integrator = {**UNDER_TEST, **UNUSUAL}[name].make(6)
        batches(scene, integrator, 128, [5])
        rays[name] = integrator.statistics.rays["shadow"]
    for name in gamblers:
        assert rays[name] < 0.8 * rays["composed_path"], rays


# ---- Output variables, and integrators that nest ours ----

AOVS = "depth:depth,normal:sh_normal,albedo:albedo"


@pytest.mark.parametrize("name", FOLLOWERS)
def test_output_variables_are_those_of_mitsuba(name: str) -> None:
    scene = mi.load_dict(stage())
    path = {"type": "path", "max_depth": 4}
    aov = mi.load_dict({"type": "aov", "aovs": AOVS, "image": path})
    own = UNDER_TEST[name].make(4, aovs=AOVS)
    images = [batches(scene, integrator, 16, [5])[0] for integrator in (own, aov)]
    assert images[0].shape[-1] == 3 + 1 + 3 + 3
    assert_same_image(*images)
    for channel in range(images[0].shape[-1]):
        assert_same_image(*(image[..., channel] for image in images))


@pytest.mark.parametrize("name", UNDER_TEST)
def test_aov_shows_the_image_of_the_nested_integrator(name: str) -> None:
    scene, inner = mi.load_dict(stage()), UNDER_TEST[name].make(4)
    aov = mi.load_dict({"type": "aov", "aovs": AOVS, "image": inner})
    images = [batches(scene, integrator, 16, [5])[0] for integrator in (aov, inner)]
    assert_same_image(images[0][..., :3], images[1])


@pytest.mark.parametrize("name", UNDER_TEST)
def test_moment_sees_single_samples(name: str) -> None:
    """Nothing is learned there, so the image is that of ``path``."""
    scene = mi.load_dict(stage())
    images = [
        batches(scene, mi.load_dict({"type": "moment", "image": inner.make(4)}), 16, [5])[0]
        for inner in (UNDER_TEST[name], REFERENCE)
    ]
    assert images[0].shape[-1] > 3
    assert_same_image(*images)


def test_output_variables_have_names() -> None:
    integrator = UNDER_TEST["composed_path"].make(4, aovs="depth:depth,nn:sh_normal")
    assert integrator.aov_names() == ["depth.T", "nn.X", "nn.Y", "nn.Z"]
