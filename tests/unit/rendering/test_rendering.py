"""The one render(): passes, stages, time budget, interruption, statistics."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering import device, interrupts, plan
from mitsuba_ext.rendering import render as rendering
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import Stage
from mitsuba_ext.transport.estimator import Sample
from tests.support.clock import PassClock
from tests.support.constant_renders import (
    HEIGHT,
    WIDTH,
    Constant,
    FixedSchedule,
    TwoStages,
    small_scene,
)
from tests.support.stage import stage

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def scene(variant: str) -> mi.Scene:
    return small_scene()


@pytest.fixture
def small_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four samples per pixel and pass."""
    for name in ("_CPU_SAMPLES", "_GPU_SAMPLES"):
        monkeypatch.setattr(device, name, 4 * WIDTH * HEIGHT)
    monkeypatch.setattr(plan, "_PASS_SPP", 1)


@pytest.mark.parametrize("can_be_frozen", [False, True])
def test_samples_of_a_stage_count_in_the_film_as_its_weight_says(scene, can_be_frozen):
    class Weighted(TwoStages):
        def schedule(self, request, samples, learning):
            first, second = (Constant(value, can_be_frozen) for value in (1.0, 3.0))
            return FixedSchedule(Stage(first, weight=0.25), Stage(second))

    for _ in range(2):
        image = Weighted(pilot_spp=8).render(scene, spp=12)
        # 8 samples that count a quarter, and 4 that count as one
        np.testing.assert_allclose(image, (8 * 0.25 * 1 + 4 * 3) / (8 * 0.25 + 4), rtol=1e-5)


def _path(name: str = "composed_path", **parameters) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 3, **parameters})


@pytest.mark.parametrize("sampler, spp, length", [("independent", 40, 14), ("stratified", 36, 1)])
def test_passes_of_large_films_keep_the_samples_of_a_pixel_together(scene, sampler, spp, length):
    """Samplers that hold a state for each sample are the exception."""
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": 2048, "height": 1024}})
    job = rendering.Job(_path(), Request(scene, sensor, 0, spp))
    assert job.plan.stages == (spp,) and job.plan.pass_length(spp) == length


def test_passes_of_expensive_samples_are_shorter(scene):
    """Else a pass would last minutes, in which nothing can stop it."""
    def length(**parameters):
        integrator = mi.load_dict({"type": "reweighted_direct", **parameters})
        job = rendering.Job(integrator, Request(scene, scene.sensors()[0], 0, 1 << 20))
        return job.plan.pass_length(1 << 20)

    assert length(light_samples=1024) <= length(light_samples=1) / 60


@pytest.mark.parametrize("name", ["neepp", "variance"])
@pytest.mark.parametrize("spp", [10**11, -1])
def test_absurd_numbers_of_samples_are_refused(scene, name, spp):
    nested = {"nested": {"type": "path"}} if name == "variance" else {}
    with pytest.raises(ValueError, match=f'"{name}".*{spp}'):
        mi.load_dict({"type": name, **nested}).render(scene, spp=spp)
    large = mi.load_dict({"type": "perspective",
                          "film": {"type": "hdrfilm", "width": 2048, "height": 1024}})
    with pytest.raises(ValueError, match="2097152 pixels are too many: give at most 16777216"):
        rendering.Job(_path(), Request(scene, large, 0, 2**30))


class _Recorder:
    """An estimator whose samples are the numbers of their pixels; it records what it draws."""

    def __init__(self) -> None:
        self.pixels, self.drawn = [], []

    def __call__(self, scene, sampler, rays, active):
        self.pixels.append(rays.pixel.numpy())
        self.drawn.append(sampler.next_1d().numpy())
        zero = dr.zeros(mi.UInt32, dr.width(rays.ray))
        return Sample(mi.Color3f(mi.Float(rays.pixel)), mi.Bool(True), zero, zero, zero)


@pytest.mark.parametrize("sampler", ["independent", "multijitter", "sobol_owen"])
def test_a_film_with_more_pixels_than_a_pass_has_lanes_is_rendered_in_parts(scene, sampler):
    """Each pixel has all of its samples, and all of them have numbers of their own."""
    estimator, integrator = _Recorder(), TwoStages(pilot_spp=1)
    integrator.sample_bytes = device.SampleBytes(device.device_of(mi.Float).pass_bytes / 40)
    integrator.schedule = lambda *rest: FixedSchedule(Stage(estimator), Stage(estimator))
    sensor = mi.load_dict({
        "type": "perspective", "sampler": {"type": sampler},
        "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
    })  # fmt: skip
    image = rendering.render(integrator, Request(scene, sensor, 0, 4)).numpy()
    expected = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(image[..., 0], expected, rtol=1e-6)
    assert [len(p) for p in estimator.pixels] == 4 * [32, 32, 32]
    assert len(np.unique(np.concatenate(estimator.drawn))) == 4 * WIDTH * HEIGHT
    assert integrator.statistics.spp == integrator.statistics.passes == 4
    assert integrator.statistics.rays["camera"] == 4 * WIDTH * HEIGHT


@pytest.mark.usefixtures("small_passes")
def test_pilot_samples_weigh_as_much_as_the_others(scene):
    integrator = TwoStages(pilot_spp=3)
    image = integrator.render(scene, 20)
    assert image == pytest.approx((3 * 1 + 17 * 3) / 20)
    assert integrator.statistics.spp == 20 and integrator.statistics.learned == "something"


@pytest.mark.usefixtures("small_passes")
@pytest.mark.parametrize(
    "sampler", ["independent", "stratified", "ldsampler", "multijitter", "sobol_owen"]
)
def test_pilots_and_passes_keep_the_sample_count(scene, sampler):
    """Stratified samplers too, whose count cannot be cut freely."""
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}})
    integrator = TwoStages(pilot_spp=3)
    integrator.spp = 64
    rendering.render(integrator, Request(scene, sensor, 0, 64))
    expected = mi.load_dict({"type": sampler})
    expected.set_sample_count(64)
    assert integrator.statistics.spp == expected.sample_count()
    assert integrator.statistics.passes > 1


@pytest.mark.parametrize("timeout", [0.05, 3.0, 8.0, 1000.0])
@pytest.mark.parametrize("sampler", ["independent", "stratified"])
def test_the_timeout_is_kept_and_cuts_the_pilots_short(scene, monkeypatch, timeout, sampler):
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler},
                           "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT,
                                    "rfilter": {"type": "box"}}})
    for name in ("_CPU_SAMPLES", "_GPU_SAMPLES"):
        monkeypatch.setattr(device, name, 8 * WIDTH * HEIGHT)
    clock = PassClock(monkeypatch)
    integrator = TwoStages(pilot_spp=25)
    request = Request(scene, sensor, 0, 144, timeout=timeout)
    image = rendering.render(integrator, request).numpy()
    done = integrator.statistics.spp
    assert done == round(clock.now / 0.1)
    if timeout > 100:
        assert done == 144
    elif timeout < 0.1:
        assert done <= 4, "a short pass of each stage"
    else:
        assert timeout * 0.9 <= clock.now <= timeout * 1.05
    pilot = round(done * (3 - image.mean()) / 2)
    assert image == pytest.approx((pilot * 1 + (done - pilot) * 3) / done)
    assert pilot <= 0.25 * done + 2


def test_compilation_counts_towards_the_timeout_but_not_as_speed(scene, monkeypatch):
    clock = PassClock(monkeypatch, compiling=1)
    integrator = TwoStages(pilot_spp=4, timeout=9.0)
    integrator.render(scene, 1000)
    assert clock.now == pytest.approx(9.0, rel=0.05)
    clock = PassClock(monkeypatch, compiling=1)
    integrator.timeout = 1.0
    integrator.render(scene, 1000)
    assert integrator.statistics.spp <= 4, "nothing is left once the kernel is there"


def test_a_timeout_keeps_sets_of_samples_whole(scene, monkeypatch):
    clock = PassClock(monkeypatch)
    integrator = mi.load_dict({"type": "reweighted_lens", "timeout": 10.0,
                               "nested": {"type": "composed_path", "max_depth": 2}})
    sensor = mi.load_dict({"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0,
                           "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}})
    integrator.render(scene, sensor, spp=1280)
    assert integrator.samples_per_set(1280) == 64 and integrator.statistics.spp == 128
    assert clock.now == pytest.approx(12.8)


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
def test_ctrl_c_in_the_last_pass_comes_too_late(scene):
    integrator = _path()
    integrator.progress = lambda fraction: fraction < 1 or os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, spp=8)
    assert integrator.statistics.spp == 8 and not integrator.statistics.interrupted


def test_second_ctrl_c_interrupts_a_pass_unless_it_comes_at_once(monkeypatch):
    with interrupts.deferred_interrupt() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.is_set()
        monkeypatch.setattr(interrupts, "TOGETHER", 0.0)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


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
    # Pilots of 1, 1 and 5 samples in passes of 1, 1, 3 and 2, the rest of 23 in passes of four
    assert len(compiled) == few.passes == 10
    assert compiled[2] == compiled[3], "a pass of a pilot had to compile"
    assert compiled[4] == compiled[9], "a pass of the last stage had to compile"
    integrator.render(scene, sensor, spp=30, seed=1)
    # Small kernels that make tables may be new, but not those that trace paths
    assert compiled[12] == compiled[13] and compiled[14] == compiled[19], "another seed compiled"
    integrator.render(scene, sensor, spp=69)
    many = integrator.statistics
    assert many.passes > 1.7 * few.passes
    assert many.memory <= 1.05 * few.memory


@pytest.mark.usefixtures("small_passes")
@pytest.mark.parametrize(
    "sampler, spp",
    # 7²: only 1 and 7 samples divide the square of a prime
    [("independent", 256), ("stratified", 256), ("orthogonal", 49), ("ldsampler", 256)],
)
def test_many_passes_have_the_mean_of_one_pass(scene, sampler, spp, monkeypatch):
    sensor = mi.load_dict(
        {"type": "perspective", "sampler": {"type": sampler},
         "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
         "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}}
    )
    integrator = _path()
    in_passes = integrator.render(scene, sensor, seed=1, spp=spp).numpy()
    assert integrator.statistics.passes >= 49
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


def test_statistics_separate_compiling_from_tracing() -> None:
    scene = mi.load_dict(stage())
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    for _ in range(2):
        integrator.render(scene, scene.sensors()[0], spp=4)
    statistics = integrator.statistics
    assert statistics.compile_seconds == 0 < statistics.tracing_seconds < statistics.seconds
    assert statistics.kernels["compiled"] == 0 < statistics.kernels["launched"]
    dr.flush_kernel_cache()
    integrator.render(scene, scene.sensors()[0], spp=4)
    assert integrator.statistics.kernels["loaded"] + integrator.statistics.kernels["compiled"] > 0


def test_an_interrupted_mi_render_says_where_the_image_is() -> None:
    scene = mi.load_dict(stage())
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3, "samples_per_pass": 1})
    integrator.progress = lambda done: signal.raise_signal(signal.SIGINT) if done < 0.3 else None
    with pytest.raises(RuntimeError) as caught:
        mi.render(scene, integrator=integrator, spp=8)
    assert "the film holds the image of the finished passes" in str(caught.value.__cause__)
    assert scene.sensors()[0].film().develop().numpy().mean() > 0


FIRST_KERNELS = """
import mitsuba_ext, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_spectral")
mi.set_log_level(mi.LogLevel.Error)
film = {"type": "hdrfilm", "width": 4, "height": 4}
scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": film},
                      "sphere": {"type": "sphere"}, "sky": {"type": "constant"}})
integrator = mi.load_dict({"type": "pss_guided", "max_depth": 3, "pilot_spp": 4})
dr.set_flag(dr.JitFlag.KernelHistory, True)
for _ in range(2):
    integrator.render(scene, spp=16).numpy()
    kernels = dr.kernel_history([dr.KernelType.JIT])
    print(*(kernel["hash"] for kernel in kernels if kernel["operation_count"] > 500))
"""


def test_the_first_spectral_render_of_a_process_has_the_kernels_of_the_next():
    """Mitsuba's colour tables were loaded between the walk and the film, which evaluates what
    learners record: the first walk was compiled and launched twice."""
    first, second = subprocess.run(
        [sys.executable, "-c", FIRST_KERNELS], capture_output=True, text=True, check=True
    ).stdout.splitlines()[-2:]
    assert first == second and len(first.split()) > 2
