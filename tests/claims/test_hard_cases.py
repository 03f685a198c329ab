"""Every integrator on every hard case: finite, non-negative pixels, and the mean of ``path``."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from tests.support.hard_cases import HARD_CASES, HardCase
from tests.support.stage import stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    THRESHOLD,
    assert_images_are_sound,
    assert_same_image,
    assert_same_pixels_on_average,
    assert_same_quarters,
    batches,
    regions,
    z_welch,
)
from tests.support.techniques import DEFAULTS, EACH_PLUGIN, REFERENCE, TECHNIQUES, pairs

pytestmark = pytest.mark.usefixtures("variant")

EACH_DEFAULT = pytest.mark.parametrize("name", EACH_PLUGIN)

#: Seeds of the references, and for a film of one pixel.
_TWO, _SIX = REFERENCE_SEEDS[:2], REFERENCE_SEEDS[:6]


def _scene(case: str) -> mi.Scene:
    """The scene is not kept, because Dr.Jit compiles the methods of all living objects into each
    kernel. It is not optimized, because the sky leaks through rectangles that Mitsuba 3.9.1 merges
    in ``path``."""
    return mi.load_dict(HARD_CASES[case].make(), optimize=False)


def _true_scene(case: str) -> mi.Scene:
    """The scene in which ``path`` renders the case correctly."""
    hard = HARD_CASES[case]
    return mi.load_dict((hard.truth or hard.make)(), optimize=False)


@functools.cache
def _images_of_path(case: str, seeds: range, spp: int) -> np.ndarray:
    hard = HARD_CASES[case]
    path = replace(REFERENCE, plugin=hard.reference).make(hard.max_depth, **hard.parameters)
    return batches(_true_scene(case), path, spp, seeds)


def _is_one_pixel(case: str) -> bool:
    return case == "film_of_one_pixel"


@pytest.mark.parametrize(("case", "name"), pairs("cases"))
def test_hard_case_has_sound_pixels_and_the_mean_of_path(case: str, name: str) -> None:
    """If the integrator draws the same random numbers as ``path``, it renders the same image."""
    hard, technique = HARD_CASES[case], TECHNIQUES[name]
    integrator = technique.make(hard.max_depth, **hard.parameters)
    scene = _scene(case)
    if technique.draws_like_path and hard.reference == REFERENCE.plugin:
        # The same scene object: Mitsuba loads in parallel, so the order of the lights varies
        path = REFERENCE.make(hard.max_depth, **hard.parameters)
        spp = hard.spp if hard.spp != HardCase.spp else 64
        truth = _true_scene(case) if hard.truth else scene
        images = batches(scene, integrator, spp, SEEDS[:1])
        expected = batches(truth, path, spp, SEEDS[:1])
        assert_images_are_sound(images)
        assert images.any() != hard.is_black, "a black image proves nothing"
        assert_same_image(images[0], expected[0])
        return
    spp, seeds, path_spp = hard.spp, SEEDS[: hard.seeds], max(hard.spp, 512)
    if technique.makes_splats and not hard.is_black:
        spp, seeds = max(1, hard.spp // 4), SEEDS[:MANY_SEEDS]
    images = batches(scene, integrator, spp, seeds)
    assert_images_are_sound(images)
    if hard.is_black:
        assert not images.any()
    elif technique.makes_splats:
        # With the same seeds, for equal camera rays
        expected = _images_of_path(case, seeds, spp)
        assert_same_quarters(images, expected, hard.precision, paired=True)
    elif _is_one_pixel(case):
        expected = _images_of_path(case, _SIX, path_spp)
        means = (i.mean(axis=(1, 2, 3)) for i in (images, expected))
        assert_same_mean_of_case(*means, hard.precision)
    else:
        expected = _images_of_path(case, _TWO, path_spp)
        assert_same_pixels_on_average(images, expected, hard.precision, unit=hard.unit)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "difference"), [("bdpt", 0.04), ("light_tracer", 0.1)])
def test_light_paths_differ_little_where_rays_start_far_above_surfaces(
    name: str, difference: float
) -> None:
    """In the means of quarters: path tracing itself is not exact there."""
    case = "moved_by_1e3_sizes"
    spp, seeds = HARD_CASES[case].spp // 4, SEEDS[:MANY_SEEDS]
    images = batches(_scene(case), TECHNIQUES[name].make(4), spp, seeds)
    assert_images_are_sound(images)
    means = [regions(x).mean(axis=0) for x in (images, _images_of_path(case, seeds, spp))]
    np.testing.assert_allclose(*means, rtol=difference)


@pytest.mark.parametrize("name", [
    "composed_path", "neepp", "pss_guided", "many_connections",
    pytest.param("bdpt", marks=pytest.mark.slow),
])  # fmt: skip
@pytest.mark.parametrize("light", [
    {"type": "constant"}, {"type": "directional", "direction": [0.1, 0, -1]},
], ids=lambda light: light["type"])  # fmt: skip
def test_no_sky_leaks_through_a_roof(light: dict, name: str) -> None:
    """Floor and roof have one material: Mitsuba merges them, and believes that the scene is no
    larger than the ball. Its ``path`` gives 0.09 and 0.16 here."""
    T = mi.ScalarTransform4f
    sides = {
        f"side_{z}": {"type": "rectangle", "to_world": T().translate([0, 0, z]).scale(100),
                      "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
        for z in (0, 5)
    }  # fmt: skip
    view = T().look_at([0, -4, 1.2], [0, 0, 0], [0, 0, 1])
    camera = {"type": "perspective", "fov": 20, "to_world": view,
              "film": {"type": "hdrfilm", "width": 8, "height": 8}}  # fmt: skip
    ball = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "conductor"}}
    scene = mi.load_dict({"type": "scene", "sensor": camera, "light": light, "ball": ball, **sides})
    image = batches(scene, TECHNIQUES[name].make(4), 64, [1])
    assert image.mean() < 0.01  # the roof ends somewhere


def assert_same_mean_of_case(a: np.ndarray, b: np.ndarray, precision: float) -> None:
    z = z_welch(a[:, None], b[:, None])[0]
    assert abs(z) < THRESHOLD, f"mean {a.mean():.6g}, path {b.mean():.6g}: z = {z:.2f}"
    error = math.hypot(a.std(ddof=1), b.std(ddof=1)) / math.sqrt(len(a)) / b.mean()
    assert error <= precision, f"too noisy to say anything: relative standard error {error:.2%}"


def _assert_same_seed(image: np.ndarray, other: np.ndarray, name: str) -> None:
    """Splats are added in the order in which threads come to them."""
    rtol = 1e-4 if TECHNIQUES[name].makes_splats else 1e-5
    np.testing.assert_allclose(image, other, rtol=rtol, atol=1e-5 * other.mean())


@EACH_DEFAULT
def test_extreme_seeds_give_images_of_their_own(name: str) -> None:
    """A seed gives the same image as a number and as a Dr.Jit value, and other seeds give other
    images."""
    scene, integrator = _scene("plain"), TECHNIQUES[name].make(4)
    seeds = [0, 2**32 - 1, 1]
    images = batches(scene, integrator, 16, seeds)
    assert_images_are_sound(images)
    for image, other in zip(images, images[[2, 2, 0]]):
        # Four standard deviations of the ratio: the mean of such an image of `path` has 9 %
        assert abs(image.mean() / other.mean() - 1) < 0.5
        assert np.abs(image - other).mean() > 0.01 * image.mean()
    for seed, image in zip(seeds[:2], images):
        array = np.array(mi.render(scene, integrator=integrator, seed=mi.UInt32(seed), spp=16))
        _assert_same_seed(array, image, name)


#: Chains are not cut into passes.
_CHAINS = ("pssmlt", "erpt", "mlt")
_IN_PASSES = [p for p in EACH_PLUGIN if getattr(p, "values", (p,))[0] not in _CHAINS]


@pytest.mark.parametrize("name", _IN_PASSES)
def test_passes_of_one_render_draw_different_numbers(name: str) -> None:
    """Sixteen passes of one sample are as exact as one pass of sixteen, not as one sample."""
    scene, integrator = _scene("plain"), TECHNIQUES[name].make(4)
    in_one = batches(scene, integrator, 16, SEEDS[:4])
    integrator.samples_per_pass = 1
    in_many = batches(scene, integrator, 16, SEEDS[:4])
    assert integrator.statistics.passes == 16
    noise = [images.std(axis=0, ddof=1).mean() for images in (in_one, in_many)]
    assert 0.8 < noise[1] / noise[0] < 1.25


@EACH_DEFAULT
def test_same_seed_gives_the_same_image(name: str) -> None:
    scene = _scene("plain")
    first, second = (batches(scene, TECHNIQUES[name].make(4), 64, [7])[0] for _ in range(2))
    _assert_same_seed(first, second, name)


@EACH_DEFAULT
def test_nothing_learned_in_one_scene_is_left_in_the_next(name: str) -> None:
    scene = _scene("plain")
    (fresh,) = batches(scene, TECHNIQUES[name].make(4), 16, [2])
    for first in ("closed_box", "empty", "constant_environment"):
        used = TECHNIQUES[name].make(4)
        batches(_scene(first), used, 16, [1])
        (image,) = batches(scene, used, 16, [2])
        _assert_same_seed(image, fresh, name)


@EACH_DEFAULT
def test_gradients_are_refused_with_a_hint_at_prb(name: str) -> None:
    import drjit as dr

    scene = mi.load_dict(stage())
    parameters = mi.traverse(scene)
    key = "light.emitter.radiance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    image = mi.render(scene, parameters, integrator=TECHNIQUES[name].make(3), spp=4)
    with pytest.raises((NotImplementedError, RuntimeError)) as caught:
        dr.backward(dr.sum(image))
    assert _mentions(caught.value, NotImplementedError, name, "prb")
    with pytest.raises((NotImplementedError, RuntimeError)) as caught:
        dr.forward(parameters[key])
        dr.forward_to(mi.render(scene, parameters, integrator=TECHNIQUES[name].make(3), spp=4))
    assert _mentions(caught.value, NotImplementedError, name, "prb")


def _mentions(error: BaseException | None, kind: type, *words: str) -> bool:
    """Whether the chain of causes contains an error of this kind with all these words. (Or a
    message that quotes one, because Mitsuba's C++ code converts errors to text.)"""
    while error is not None:
        text = str(error)
        if (isinstance(error, kind) or kind.__name__ in text) and all(w in text for w in words):
            return True
        error = error.__cause__ or error.__context__
    return False


_WRONG = [
    (TypeError, {"max_depth": "six"}),
    (TypeError, {"max_depth": 3.5}),
    (ValueError, {"max_depth": -2}),
    (ValueError, {"rr_depth": 0}),
    (TypeError, {"rr_depth": True}),
    (TypeError, {"timeout": "long"}),
    (TypeError, {"hide_emitters": 3}),
    (TypeError, {"aovs": 1}),
]
_WRONG_REJECTION = [
    (ValueError, {"grid": 0}),
    (ValueError, {"grid": 100_000}),
    (TypeError, {"grid": 4.5}),
    (ValueError, {"refine": -1}),
    (ValueError, {"pilot_spp": -1}),
    (ValueError, {"max_memory": 0.0}),
    (ValueError, {"max_memory": math.nan}),
    (ValueError, {"max_memory": math.inf}),
    (ValueError, {"law": "Paper"}),
    (TypeError, {"law": 2}),
    (ValueError, {"slope": -1.0}),
    (ValueError, {"slope": math.nan}),
    (ValueError, {"floor": 0.0}),
    (ValueError, {"floor": 1.5}),
    (ValueError, {"floor": math.nan}),
    (ValueError, {"light_sampling": "spacial"}),
    (TypeError, {"rejection": "yes"}),
    (TypeError, {"load_learned": 3}),
]
_WRONG_GUIDING = [
    (ValueError, {"regions": "walls"}),
    (TypeError, {"regions": 4}),
    (ValueError, {"bounces": 0}),
    (ValueError, {"bounces": 65}),
    (TypeError, {"nee_first_bounce": 1}),
    (ValueError, {"pilot_spp": -1}),
    (TypeError, {"pilot_spp": 3.5}),
    (ValueError, {"max_memory": 0.0}),
    (ValueError, {"max_memory": math.nan}),
]
WRONG_VALUES = [(name, *wrong) for name in DEFAULTS for wrong in _WRONG]
# Most of them are known only where shadow rays are rejected, by a map of their own
_REJECTION = {"light_sampling": "uniform", "rejection": True}
WRONG_VALUES += [
    ("neepp", kind, {**wrong, **({} if wrong.keys() & _REJECTION.keys() else _REJECTION)})
    for kind, wrong in _WRONG_REJECTION
]
WRONG_VALUES += [("pss_guided", *wrong) for wrong in _WRONG_GUIDING]
WRONG_VALUES += [("composed_path", ValueError, {"shadow_test": "sometimes"})]
WRONG_VALUES += [("composed_path", ValueError, {"next_event": "always"})]


@pytest.mark.parametrize(("name", "kind", "wrong"), WRONG_VALUES)
def test_wrong_value_is_named_with_its_parameter_and_plugin(
    name: str, kind: type, wrong: dict
) -> None:
    (parameter, value), *_needed = wrong.items()
    with pytest.raises((TypeError, ValueError, RuntimeError)) as caught:
        mi.load_dict({"type": TECHNIQUES[name].plugin, **wrong})
    assert _mentions(caught.value, kind, f'"{TECHNIQUES[name].plugin}"', parameter, repr(value))


@pytest.mark.parametrize(
    ("plugin", "unknown"),
    [
        ("composed_path", "max_depht"),
        ("composed_path", "grid"),  # of nested decisions
        ("neepp", "voxels"),
        ("pss_guided", "tile"),  # known only with regions=tiles
    ],
)
def test_unknown_parameter_is_refused(plugin: str, unknown: str) -> None:
    with pytest.raises(RuntimeError, match=f'"{plugin}"(: nothing| has).*"{unknown}"'):
        mi.load_dict({"type": plugin, unknown: 4})


@pytest.mark.parametrize(("arguments", "message"), [
    (("scene.xml",), "a scene is needed .*, found an object of type str"),
    ((None, 0, 0, 4.5), "spp is 4.5; it must be a whole number"),
    ((None, 0, 0, "4"), "spp is '4'; it must be a whole number"),
])  # fmt: skip
def test_wrong_arguments_of_render_are_named(arguments: tuple, message: str) -> None:
    scene, *others = arguments
    with pytest.raises(TypeError, match=f'"neepp": {message}'):
        TECHNIQUES["neepp"].make(2).render(scene or _scene("plain"), *others)


def test_integrators_and_scenes_of_another_variant_are_refused() -> None:
    integrator, scene, active = TECHNIQUES["neepp"].make(2), _scene("plain"), mi.variant()
    try:
        mi.set_variant("llvm_ad_mono" if "llvm" in active else "cuda_ad_mono")
        with pytest.raises(ValueError, match=f'"neepp" was made in the variant "{active}"'):
            integrator.render(scene, spp=1)
        with pytest.raises(ValueError, match=f'the scene was made in the variant "{active}"'):
            TECHNIQUES["neepp"].make(2).render(scene, spp=1)
    finally:
        mi.set_variant(active)


@pytest.mark.parametrize("name", ["neepp", "mlt"])
def test_a_sampler_without_samples_is_refused(name: str) -> None:
    scene = mi.load_dict(stage())
    scene.sensors()[0].sampler().set_sample_count(0)
    with pytest.raises(ValueError, match="the sampler has 0 samples per pixel"):
        mi.load_dict({"type": name, "max_depth": 3}).render(scene)


def test_missing_sensor_is_named() -> None:
    with pytest.raises(ValueError, match="there is no sensor 1: the scene has 1"):
        TECHNIQUES["neepp"].make(2).render(_scene("plain"), sensor=1, spp=1)
