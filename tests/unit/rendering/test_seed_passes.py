"""Mitsuba's own integrators in passes over seeds fill the film as one render does."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering import seed_passes
from mitsuba_ext.rendering.batches import batch_seeds
from mitsuba_ext.rendering.seed_passes import SeedPasses
from tests.support.batched import film_channels, small_scene

pytestmark = pytest.mark.usefixtures("variant")

AOV = {"type": "aov", "aovs": "d:depth", "inner": {"type": "path"}}


@pytest.fixture(autouse=True)
def small_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four samples per pixel and pass."""
    monkeypatch.setattr(seed_passes, "_PASS_SAMPLES", {dr.JitBackend.LLVM: 1})


def test_seeds_of_passes_differ_from_seeds_of_batches() -> None:
    for seed in (0, 7):
        passes = mi.sample_tea_32(mi.UInt32(seed), seed_passes._STREAM + dr.arange(mi.UInt32, 64))
        assert not set(passes[1].numpy().tolist()) & set(batch_seeds(seed, 4096))


@pytest.mark.parametrize(
    "integrator", [{"type": "path"}, {"type": "prb"}, {"type": "ptracer"}, AOV],
    ids=lambda parameters: parameters["type"],
)  # fmt: skip
@pytest.mark.parametrize(
    "film",
    [{"rfilter": {"type": "lanczos"}, "sample_border": True}, {"pixel_format": "luminance_alpha"}],
    ids=["negative lobes", "luminance"],
)
def test_the_film_holds_the_mean_of_all_samples(monkeypatch, integrator, film):
    """Passes of 4, 4 and 2 samples."""
    scene, integrator = small_scene(7, 5, **film), mi.load_dict(integrator)
    sensor, kept = scene.sensors()[0], []
    render = integrator.render

    class Recorder:
        """The integrator, and what its renders leave in the film."""

        def __getattr__(self, name):
            return getattr(integrator, name)

        def render(self, scene, sensor, seed, spp):
            image = render(scene, sensor, seed, spp)
            kept.append((seed, spp, sensor.film().develop(raw=True).numpy()))
            return image

    passes = SeedPasses(Recorder(), scene, sensor, 3)
    fractions = []
    passes.run(10, progress=fractions.append)
    assert (passes.passes, passes.spp, passes.interrupted) == (3, 10, False)
    assert [spp for _, spp, _ in kept] == [4, 4, 2]
    assert kept[0][0] == 3 and len({seed for seed, _, _ in kept}) == 3
    assert fractions == pytest.approx([1 / 3, 2 / 3, 1])

    raw = sensor.film().develop(raw=True).numpy()
    if integrator.class_name() == "ParticleTracerIntegrator":  # images, not sums
        expected = sum(spp * contents for _, spp, contents in kept) / 10
    else:
        expected = sum(contents for _, _, contents in kept)
    np.testing.assert_allclose(raw, expected, rtol=1e-5, atol=1e-6 * expected.max())
    names = [name for name in film_channels(scene) if name not in "RGBAXYZ"]
    assert names == list(integrator.aov_names())


def test_a_short_render_is_the_integrators_own_image():
    scene, path = small_scene(6, 5), mi.load_dict({"type": "path"})
    sensor = scene.sensors()[0]
    expected = path.render(scene, seed=2**32 - 1, spp=4).numpy()
    SeedPasses(path, scene, sensor, 2**32 - 1).run(4)
    np.testing.assert_allclose(sensor.film().develop().numpy(), expected, rtol=1e-5, atol=1e-7)



@pytest.mark.parametrize(
    "sampler", ["stratified", "multijitter", "orthogonal", "ldsampler", "sobol_owen"]
)
def test_passes_of_structured_samplers_are_whole_sets(sampler):
    scene = small_scene(3, 2, sampler=sampler)
    passes = SeedPasses(mi.load_dict({"type": "direct"}), scene, scene.sensors()[0], 0)
    passes.run(300)
    length = seed_passes.pass_length(scene.sensors()[0])
    assert length >= 64 and 300 <= passes.spp < 300 + length


def test_passes_of_structured_samplers_are_short_for_large_films():
    """Else a pass would last longer than the 30 seconds that batch systems wait."""
    lengths = {}
    for width, height in ((640, 360), (1920, 1080)):
        film = {"type": "hdrfilm", "width": width, "height": height}
        sensor = mi.load_dict(
            {"type": "perspective", "film": film, "sampler": {"type": "multijitter"}}
        )
        lengths[width] = seed_passes.pass_length(sensor)
    assert lengths == {640: 64, 1920: 16}


def test_time_fixes_the_number_of_passes_by_the_first_that_compiles_nothing(monkeypatch):
    """Passes of 2, 2 and then 1 seconds; the first one compiles."""
    scene = small_scene(3, 2)
    passes = SeedPasses(mi.load_dict({"type": "path"}), scene, scene.sensors()[0], 0)

    def run_pass(spp):
        passes.passes += 1
        return (2.0, True) if passes.passes == 1 else (2.0 if passes.passes == 2 else 1.0, False)

    monkeypatch.setattr(passes, "_run_pass", run_pass)
    monkeypatch.setattr(passes._sums, "fill", lambda *_: None)
    passes.run(0, seconds=9.0)
    assert passes.passes == 4


def test_only_mitsubas_own_integrators_are_cut_into_passes():
    def can_render(parameters):
        return seed_passes.can_render(mi.load_dict(parameters))

    assert can_render(AOV) and can_render({"type": "volpath"})
    assert not can_render({"type": "neepp"})
    assert not can_render({**AOV, "inner": {"type": "neepp"}}), "would learn in each pass"
    assert not can_render({"type": "variance", "nested": {"type": "path"}})
