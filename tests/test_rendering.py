"""The one render(): passes, stages, time budget, interruption, statistics."""

from __future__ import annotations

import os
import signal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import rendering
from mitsuba_ext.rendering import Stage
from mitsuba_ext.walk import PathSample

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 12, 8


@pytest.fixture
def scene(variant: str) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT,
                         "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 5},
            },
            "sphere": {"type": "sphere"},
            "lamp": {"type": "point", "position": [2, 3, 4]},
        }
    )


@pytest.fixture
def small_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four samples per pixel and pass."""
    limits = {dr.JitBackend.LLVM: 4 * WIDTH * HEIGHT}
    monkeypatch.setattr(rendering, "_PASS_SAMPLES", limits)
    monkeypatch.setattr(rendering, "_PASS_SPP", 1)


class _Constant:
    """A walk whose every sample is worth the same."""

    def __init__(self, value: float) -> None:
        self.value = value

    def __call__(self, scene, sampler, ray, active, pixel, hero_weight):
        zero = dr.zeros(mi.UInt32, dr.width(ray))
        return PathSample(mi.Color3f(self.value), mi.Bool(True), zero, zero, zero)


class _TwoStages:
    """Two stages of constants: a pilot worth 1 and a rest worth 3."""

    def __init__(self, pilot_spp: int, timeout: float = -1) -> None:
        self.pilot_spp, self.timeout, self.samples_per_pass = pilot_spp, timeout, 2**32 - 1
        self.progress, self.is_cancelled = None, False

    def pilots(self, scene, spp):
        return [self.pilot_spp]

    def samples_per_set(self, spp):
        return 1

    def stages(self, scene, sensor, samples, seed):
        yield Stage(_Constant(1.0))
        yield Stage(_Constant(3.0), "something")

    def aov_names(self):
        return []

    def sample_aovs(self, scene, sampler, ray):
        return []

    def render(self, scene, spp, **rest):
        return rendering.render(self, scene, 0, 0, spp, True, True).numpy()


def _path(name: str = "composed_path", **parameters) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 3, **parameters})


@pytest.mark.parametrize(
    "sampler, plan", [("independent", [[14, 14, 12]]), ("stratified", [[1] * 36])]
)
def test_passes_of_large_films_keep_the_samples_of_a_pixel_together(scene, sampler, plan):
    """But for samplers that hold a state for each sample."""
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": 2048, "height": 1024}})
    job = rendering._Job(_path(), scene, sensor, 0, 36 if sampler == "stratified" else 40)
    assert job.plan == plan


@pytest.mark.usefixtures("small_passes")
def test_pilot_samples_weigh_as_much_as_the_others(scene):
    integrator = _TwoStages(pilot_spp=3)
    image = integrator.render(scene, 20)
    assert image == pytest.approx((3 * 1 + 17 * 3) / 20)
    assert integrator.statistics.spp == 20 and integrator.statistics.learned == "something"


@pytest.mark.usefixtures("small_passes")
@pytest.mark.parametrize("sampler", ["independent", "stratified", "ldsampler", "multijitter"])
def test_pilots_and_passes_keep_the_sample_count(scene, sampler):
    """Stratified samplers too, whose count cannot be cut freely."""
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}})
    integrator = _TwoStages(pilot_spp=3)
    integrator.spp = 64
    rendering.render(integrator, scene, sensor, 0, 64, True, True)
    expected = mi.load_dict({"type": sampler})
    expected.set_sample_count(64)
    assert integrator.statistics.spp == expected.sample_count()
    assert integrator.statistics.passes > 1


@pytest.mark.usefixtures("small_passes")
@pytest.mark.parametrize("timeout", [0.5, 90.0])
def test_the_timeout_fixes_the_number_of_passes_from_the_speed_of_the_first(
    scene, monkeypatch, timeout
):
    """On a clock that jumps by a second at each reading."""
    _TwoStages(pilot_spp=10).render(scene, 100)  # compiles
    clock = iter(range(10**9))
    monkeypatch.setattr(rendering.time, "perf_counter", lambda: float(next(clock)))
    integrator = _TwoStages(pilot_spp=10, timeout=timeout)
    image = integrator.render(scene, 100)
    done = integrator.statistics.spp
    assert integrator.statistics.passes == done, "a pass of one sample each"
    assert (done == 11) if timeout < 1 else (11 < done < 100)
    assert image == pytest.approx((10 * 1 + (done - 10) * 3) / done)


@pytest.mark.usefixtures("small_passes")
def test_cancelling_returns_the_image_of_the_finished_passes(scene):
    integrator = _path()
    whole = mi.render(scene, integrator=integrator, spp=8).numpy()
    integrator.progress = lambda fraction: integrator.cancel() if fraction >= 0.5 else None
    image = integrator.render(scene, spp=16).numpy()
    assert integrator.statistics.interrupted and integrator.statistics.spp == 8
    np.testing.assert_allclose(image, whole, rtol=1e-5)
    integrator.progress = None
    integrator.render(scene, spp=16)
    assert integrator.statistics.spp == 16, "a later render is not cancelled"


@pytest.mark.usefixtures("small_passes")
def test_ctrl_c_leaves_the_finished_passes_in_the_film(scene):
    integrator = _path()
    whole = mi.render(scene, integrator=integrator, spp=4).numpy()
    integrator.progress = lambda fraction: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, spp=16)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 4
    image = np.array(scene.sensors()[0].film().bitmap())
    np.testing.assert_allclose(image, whole, rtol=1e-5)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("small_passes")
def test_an_error_in_the_progress_callback_leaves_a_valid_film(scene):
    integrator = _path()

    def fail(fraction: float) -> None:
        raise OSError("no terminal")

    integrator.progress = fail
    with pytest.raises(OSError, match="no terminal"):
        integrator.render(scene, spp=16)
    assert np.isfinite(np.array(scene.sensors()[0].film().bitmap())).all()


@pytest.mark.usefixtures("small_passes")
def test_passes_share_kernels_and_memory(scene):
    """With a filter that spreads samples, and with a shorter pass at the end."""
    sensor = mi.load_dict(
        {"type": "perspective",
         "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT,
                  "rfilter": {"type": "gaussian"}}}
    )
    integrator = _path("neepp")
    compiled: list[int] = []
    integrator.progress = lambda _: compiled.append(sum(dr.detail.launch_stats()[1:]))
    integrator.render(scene, sensor, spp=30)
    few = integrator.statistics
    # Pilots of 1 and 6 samples in passes of 1, 3 and 3, the rest of 23 in passes of four
    assert len(compiled) == few.passes == 9
    assert compiled[1] == compiled[2], "a pass of a pilot had to compile"
    assert compiled[3] == compiled[8], "a pass of the last stage had to compile"
    integrator.render(scene, sensor, spp=30, seed=1)
    # Small ones that make tables may be new, but none of those that trace
    assert compiled[10] == compiled[11] and compiled[12] == compiled[17], "another seed compiled"
    integrator.render(scene, sensor, spp=69)
    many = integrator.statistics
    assert many.passes > 1.9 * few.passes
    assert many.memory <= 1.05 * few.memory


@pytest.mark.usefixtures("small_passes")
@pytest.mark.parametrize(
    "sampler, spp",
    # 17²: only 1 and 17 samples divide the square of a prime
    [("independent", 1024), ("stratified", 1024), ("orthogonal", 289), ("ldsampler", 1024)],
)
def test_many_passes_estimate_what_one_does(scene, sampler, spp, monkeypatch):
    sensor = mi.load_dict(
        {"type": "perspective", "sampler": {"type": sampler},
         "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
         "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}}
    )
    integrator = _path()
    in_passes = integrator.render(scene, sensor, seed=1, spp=spp).numpy()
    assert integrator.statistics.passes > 50
    monkeypatch.undo()
    at_once = integrator.render(scene, sensor, seed=2, spp=spp).numpy()
    assert integrator.statistics.passes == 1
    assert in_passes.mean() == pytest.approx(at_once.mean(), rel=2e-3)
    assert np.abs(in_passes - at_once).max() < 0.05 * at_once.max()


def test_rays_are_counted_by_kind(scene):
    """One lamp, one convex object: a connection per hit, no shadow ray towards its dark side."""
    integrator = _path()
    integrator.render(scene, spp=16)
    statistics = integrator.statistics
    hits = statistics.connections
    assert statistics.rays["camera"] == WIDTH * HEIGHT * 16
    assert 0 < hits < statistics.rays["camera"] and statistics.rays["scatter"] == hits
    assert 0 < statistics.rays["shadow"] < hits
    assert statistics.zero_radiance == pytest.approx(
        1 - statistics.rays["shadow"] / statistics.rays["camera"], abs=1e-6
    )
    assert statistics.seconds > 0 and statistics.memory > 0 and not statistics.interrupted


def test_render_takes_the_arguments_that_mitsuba_takes(scene):
    integrator, sensor = _path(), scene.sensors()[0]
    image = integrator.render(scene, sensor=sensor, seed=mi.UInt32(7), spp=4).numpy()
    assert (image == integrator.render(scene, 0, 7, 4).numpy()).all()
    assert not (image == integrator.render(scene, 0, 8, 4).numpy()).all()
    assert integrator.render(scene, seed=7, spp=4, develop=False).shape == (0,)
    np.testing.assert_array_equal(np.array(sensor.film().bitmap()), image)
    lazy = integrator.render(scene, seed=7, spp=4, evaluate=False).numpy()
    np.testing.assert_array_equal(lazy, image)
    integrator.render(scene)
    assert integrator.statistics.spp == 5, "spp=0 means the sampler's count"
    assert sensor.sampler().sample_count() == 5, "the scene's sampler is left as it was"
    with pytest.raises(ValueError, match="there is no sensor 1"):
        integrator.render(scene, sensor=1)
