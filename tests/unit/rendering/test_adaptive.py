"""Adaptive samples are unbiased, go where the error is large, and leave no pixel without
samples."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering import device, plan
from mitsuba_ext.rendering.pixel_moments import PixelMoments
from mitsuba_ext.rendering.sample_allocation import SampleAllocation
from mitsuba_ext.rendering.statistics import kernel_cache_misses
from tests.support.batched import film_channels
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor, stage
from tests.support.statistical import assert_images_are_sound, assert_same_mean, batches

pytestmark = pytest.mark.usefixtures("variant")

PATH = {"type": "composed_path", "max_depth": 3}


def adaptive(nested: dict | None = PATH, **parameters: Any) -> mi.Integrator:
    children = {"nested": nested} if nested else {}
    return mi.load_dict({"type": "adaptive", **parameters, **children})


def small(*size: int, sampler: str = "independent", **changes: Any) -> mi.Scene:
    """The stage under a small lamp, in front of nothing."""
    camera = sensor(film=film(*(size or (16, 16)), **changes), sampler=sampler)
    return mi.load_dict(stage(camera=camera))


# ---- Without a renderer: a spike in few of the samples ----

SIDE = 24
CHANCE, SPIKE = 0.02, 50.0


def _spiky(random: np.random.Generator, pixels: np.ndarray) -> np.ndarray:
    return np.where(random.random(len(pixels)) < CHANCE, SPIKE, 0.5 * random.random(len(pixels)))


def _image(seed: int, threshold: float = 0.0, is_naive: bool = False, spp: int = 32) -> np.ndarray:
    """What the film shows: the sum of weighted samples over the sum of weights."""
    random = np.random.default_rng(seed)
    moments = PixelMoments(SIDE, SIDE)
    allocation = SampleAllocation(moments, spp, 4, threshold)
    total, weights = np.zeros(SIDE * SIDE), np.zeros(SIDE * SIDE)
    sets, weight = allocation.first(4)
    for left in range(7, -1, -1):
        pixels = np.repeat(np.arange(SIDE * SIDE), sets.numpy())
        values = _spiky(random, pixels)
        moments.add(mi.UInt32(pixels), mi.Float(values))
        scale = np.ones_like(values) if is_naive else weight.numpy()[pixels]
        total += np.bincount(pixels, scale * values, SIDE * SIDE)
        weights += np.bincount(pixels, scale, SIDE * SIDE)
        if left > 0 and allocation.has_active:
            sets, weight = allocation.next(4 * SIDE * SIDE, left == 1, 1 / left)
        else:
            break
    assert is_naive or np.allclose(weights, 1), "the film divides by one, and not by chance"
    return total / weights


def _z(is_naive: bool, threshold: float = 0.0) -> float:
    means = [_image(seed, threshold, is_naive).mean() for seed in range(64)]
    expected = CHANCE * SPIKE + (1 - CHANCE) * 0.25
    return (np.mean(means) - expected) / (np.std(means, ddof=1) / 8)


@pytest.mark.parametrize("threshold", [0.0, 0.7])
def test_mean_of_64_short_renders_is_unbiased_where_equal_weights_are_not(threshold):
    assert abs(_z(is_naive=False, threshold=threshold)) < 4
    assert _z(is_naive=True, threshold=threshold) < -5


def test_no_pixel_is_starved_and_the_sum_is_kept():
    moments = PixelMoments(SIDE, SIDE)
    allocation = SampleAllocation(moments, 64, 8)
    pixels = np.repeat(np.arange(SIDE * SIDE), allocation.first(8)[0].numpy())
    values = np.where(pixels == 100, _spiky(np.random.default_rng(1), pixels), 1.0)
    moments.add(mi.UInt32(pixels), mi.Float(values))
    sets = allocation.next(8 * SIDE * SIDE, True, 1.0)[0].numpy().astype(int)
    assert sets.min() >= 1 and abs(sets.sum() - 8 * SIDE * SIDE) <= 1
    assert sets.argmax() == 100


def test_the_variance_of_sets_is_the_variance_of_their_means():
    """Stratified samples vary within a set, and less between sets."""
    moments = PixelMoments(1, 1, set_size=4)
    moments.add(dr.zeros(mi.UInt32, 8), mi.Float(np.tile([0.0, 1.0, 2.0, 3.0], 8)))
    assert moments.deviation()[0] == 0 and moments.count[0] == moments.total == 32


@pytest.mark.parametrize(("x", "y"), [(2, 1), (0, 0), (4, 3)])
def test_a_pixel_shares_its_variance_with_those_around_it(x: int, y: int) -> None:
    width, height = 5, 4
    moments = PixelMoments(width, height)
    pixels = np.repeat(np.arange(width * height), 2)
    values = np.where(pixels == y * width + x, np.tile([0.0, 1.0], width * height), 0)
    moments.add(mi.UInt32(pixels), mi.Float(values))
    rows, columns = np.indices((height, width))
    is_near = (abs(rows - y) <= 1) & (abs(columns - x) <= 1)
    found = moments.deviation().numpy().reshape(height, width)
    np.testing.assert_array_equal(found > 0, is_near)


def test_a_black_image_gets_equal_samples():
    moments = PixelMoments(4, 4)
    allocation = SampleAllocation(moments, 64, 8)
    moments.add(mi.UInt32(np.repeat(np.arange(16), 8)), dr.full(mi.Float, np.nan, 128))
    assert (allocation.next(160, True, 1.0)[0].numpy() == 10).all()


# ---- Renders ----


def test_a_pass_in_parts_samples_every_pixel(monkeypatch):
    """Each pixel sees the same sky, and therefore gets the same number of samples."""
    monkeypatch.setattr(device, "_CPU_SAMPLES", 100)
    monkeypatch.setattr(plan, "_PASS_SPP", 1)
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": 2.0}})
    sensor = mi.load_dict({"type": "perspective", "film": film(16, 12)})
    integrator = adaptive(count_samples=True)
    image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=16))
    np.testing.assert_allclose(image[..., :3], 2, rtol=1e-5)
    np.testing.assert_array_equal(np.round(image[..., 3]), 16)
    assert integrator.statistics.passes > 8  # the default


def _rare_lamp() -> mi.Scene:
    """A lamp that paths find by running into it, one in a hundred."""
    floor = rectangle(mi.ScalarTransform4f().scale(2), bsdf=diffuse(0.8))
    lamp = {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.12, "emitter": area(40.0)}
    camera = sensor(to_world=lookat([0, -2, 0.5], [0, 0, 0], [0, 0, 1]), film=film(16, 16))
    return mi.load_dict({"type": "scene", "floor": floor, "lamp": lamp, "sensor": camera})


@pytest.mark.slow
@pytest.mark.parametrize("is_naive", [False, True])
def test_mean_of_64_short_renders_of_a_rare_lamp(is_naive, monkeypatch):
    if is_naive:
        take = SampleAllocation._take
        monkeypatch.setattr(
            SampleAllocation, "_take",
            lambda self, sets, weight: dr.select(take(self, sets, weight) > 0, mi.Float(1), 0),
        )  # fmt: skip
    blind = {**PATH, "max_depth": 2, "hide_emitters": True, "mis": "bsdf"}
    scene = _rare_lamp()
    reference = batches(scene, mi.load_dict({**PATH, "max_depth": 2, "hide_emitters": True}), 256,
                        range(1001, 1005)).mean(axis=(1, 2, 3))  # fmt: skip
    means = batches(scene, adaptive(blind), 16, range(64)).mean(axis=(1, 2, 3))
    error = np.hypot(means.std(ddof=1) / 8, reference.std(ddof=1) / 2)
    z = (means.mean() - reference.mean()) / error
    assert z < -6 if is_naive else abs(z) < 4


@pytest.mark.parametrize("nested", [
    {"type": "path", "max_depth": 3},
    PATH,
    pytest.param({"type": "neepp", "max_depth": 3}, marks=pytest.mark.slow),
    pytest.param({"type": "bdpt", "max_depth": 3, "light_image": False}, marks=pytest.mark.slow),
], ids=lambda nested: nested["type"])  # fmt: skip
def test_mean_agrees_with_the_nested_integrator(nested):
    scene = small(rfilter={"type": "gaussian"})
    images = batches(scene, adaptive(nested), 64, range(8))
    assert_images_are_sound(images)
    reference = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 256,
                        range(1001, 1009))  # fmt: skip
    assert_same_mean(images, reference, 0.02)


def test_samples_go_to_noisy_pixels_and_every_pixel_gets_some():
    scene = small(sample_border=True, rfilter={"type": "gaussian"})
    integrator = adaptive(count_samples=True)
    image = np.array(mi.render(scene, integrator=integrator, seed=1, spp=64))
    counts = film_channels(scene)["samples"]
    assert image.shape[2] == 4 and np.allclose(image[..., 3], counts)
    assert np.allclose(counts, np.round(counts), atol=0.05)
    assert counts.min() >= 8 + 6.9 and counts.max() > 2 * counts.min()
    assert integrator.statistics.spp == 64
    assert integrator.statistics.rays["camera"] == pytest.approx(64 * 20 * 20, rel=0.02)


def test_a_white_film_stays_white():
    """Every weight that a sample gets is divided by."""
    camera = sensor(film=film(12, 9, rfilter={"type": "gaussian"}))
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "sensor": camera})
    image = np.array(mi.render(scene, integrator=adaptive(), spp=40))
    assert np.allclose(image, 1, rtol=1e-5)


def test_threshold_ends_the_render_and_is_about_met():
    scene = small()
    integrator = adaptive(threshold=0.1, pass_spp=16)
    images = batches(scene, integrator, 1024, range(4))
    assert 16 < integrator.statistics.spp < 512 and not integrator.statistics.interrupted
    brightness = images.mean(axis=3)
    scale = np.sqrt(brightness.mean(axis=0) ** 2 + 0.01 * brightness.mean() ** 2)
    error = np.sqrt((brightness.std(axis=0, ddof=1) ** 2 / scale**2).mean())
    assert 0.03 < error < 0.15


@pytest.mark.parametrize("sampler", ["multijitter", "ldsampler"])
def test_stratified_samplers_come_in_whole_sets(sampler):
    scene = small(sampler=sampler)
    integrator = adaptive(count_samples=True, pass_spp=16)
    image = np.array(mi.render(scene, integrator=integrator, seed=3, spp=64))
    assert (np.round(image[..., 3]) % 4 == 0).all() and image[..., 3].max() > image[..., 3].min()


def test_a_sampler_whose_small_sets_are_biased_is_refused():
    with pytest.raises(NotImplementedError, match='"stratified" depend on each other'):
        adaptive().render(small(sampler="stratified"), spp=16)


def test_passes_of_any_length_share_a_kernel():
    scene, integrator = small(8, 8), adaptive()
    mi.render(scene, integrator=integrator, seed=1, spp=32).numpy()
    before = kernel_cache_misses()
    mi.render(scene, integrator=integrator, seed=2, spp=40).numpy()
    assert kernel_cache_misses() == before


@pytest.mark.parametrize("spp", [1, 2, 3, 9])
def test_few_samples_are_enough(spp):
    scene = small(5, 3)
    integrator = adaptive()
    image = np.array(mi.render(scene, integrator=integrator, seed=0, spp=spp))
    assert np.isfinite(image).all() and integrator.statistics.spp == spp


def test_a_cancelled_render_keeps_its_finished_samples():
    scene = small(8, 8)
    integrator = adaptive()
    integrator.progress = lambda done: integrator.cancel() if done > 0.3 else None
    image = np.array(mi.render(scene, integrator=integrator, seed=0, spp=64))
    assert integrator.statistics.interrupted and 16 <= integrator.statistics.spp < 64
    assert image.mean() > 0


def test_a_time_limit_ends_with_a_whole_image():
    scene = small(8, 8)
    integrator = adaptive(timeout=0.2)
    images = batches(scene, integrator, 1 << 16, [1, 2])
    assert not integrator.statistics.interrupted and integrator.statistics.spp < 1 << 16
    assert_images_are_sound(images)

@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_films_show_the_mean_but_no_counts(variant: str) -> None:
    band = {"type": "irregular", "wavelengths": "400, 500, 600", "values": "0, 1, 0"}
    spectral = {"type": "specfilm", "width": 6, "height": 5, "rfilter": {"type": "box"},
                "band": band}  # fmt: skip
    scene = mi.load_dict(stage(camera=sensor(film=spectral)))
    images = batches(scene, adaptive(), 128, range(8))
    path = batches(scene, mi.load_dict({"type": "path", "max_depth": 3}), 512, range(1001, 1009))
    assert_same_mean(images, path, 0.06)
    with pytest.raises(Exception, match='"adaptive": the film "SpecFilm".*"count_samples"'):
        adaptive(count_samples=True).render(scene, spp=4)


# ---- Errors ----


@pytest.mark.parametrize("nested, message", [
    ({"type": "bdpt"}, '"bdpt": .* set "light_image" to false'),
    ({"type": "light_tracer"}, '"light_tracer": its light paths'),
    ({"type": "erpt"}, '"erpt": its chains'),
    ({"type": "pssmlt"}, '"pssmlt": its chains'),
    ({"type": "mlt"}, '"mlt": its chains'),
    ({"type": "composed_path", "aperture": "sobol"}, 'of "aperture" belong together'),
    ({"type": "reweighted_lens", "nested": {"type": "path"}}, "sets of numbers"),
    ({"type": "reweighted_lens", "nested": {"type": "adaptive", "nested": {"type": "path"}}},
     "sets of numbers"),
    ({"type": "adaptive", "nested": {"type": "path"}}, "exactly one integrator"),
    ({"type": "ptracer"}, "exactly one integrator"),
    ({"type": "prb"}, "none for gradients"),
    (None, "found none"),
])  # fmt: skip
def test_integrators_that_need_equal_samples_are_refused(nested, message):
    with pytest.raises(RuntimeError, match=message):
        adaptive(nested)


@pytest.mark.parametrize("parameters, message", [
    ({"threshold": -1.0}, "at least 0"), ({"pass_spp": -1}, "at least 0"),
    ({"hide_emitters": True}, "in the nested integrator"), ({"passspp": 4}, "passspp"),
])  # fmt: skip
def test_wrong_parameters_are_refused(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        adaptive(**parameters)
