"""Renders with a timeout plan their pilots for the samples that fit, and passes of all lengths
share their kernels."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths import light_walk
from mitsuba_ext.planning import verdicts
from mitsuba_ext.rendering import pace
from mitsuba_ext.rendering import render as rendering
from mitsuba_ext.rendering.plan import RenderPlan
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import ChangedSchedule, Learning, OneStage, Stage
from mitsuba_ext.util.arrays import add_own, channel_mean
from tests.support.stage import area, stage

pytestmark = pytest.mark.usefixtures("variant")


def _scene(**objects: Any) -> mi.Scene:
    lamp = {"type": "sphere", "center": [1, -1, 1.5], "radius": 0.2, "emitter": area(3.0)}
    return mi.load_dict(stage(second=lamp, **objects))


def _integrator(name: str, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 4, **parameters})


@pytest.fixture(autouse=True)
def short_renders_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)


class _Clock:
    """A clock that only passes advance: each sample per pixel takes a tenth of a second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, compiling: float = 0.0) -> None:
        self.now, self.compiling = 0.0, compiling
        run_pass = rendering.Job.run_pass

        def run_on_clock(job, stage, spp):
            run_pass(job, stage, spp)
            job.statistics.compile_seconds = self.compiling if job.statistics.passes == 1 else 0.0
            is_new = job.statistics.passes == 1 and self.compiling > 0
            self.now += 0.1 * spp + (self.compiling if is_new else 0.0)
            return is_new

        monkeypatch.setattr(rendering.Job, "run_pass", run_on_clock)
        monkeypatch.setattr(rendering.time, "perf_counter", lambda: self.now)
        monkeypatch.setattr(pace, "_SHORT_PASS", 1)


def test_the_pilots_are_planned_for_the_samples_that_fit_into_the_time(monkeypatch):
    clock, asked = _Clock(monkeypatch), []
    integrator = _integrator("auto_path", timeout=10.0)
    plan = integrator.plan_learning

    def remembered(request, spp, *kernels):
        asked.append(spp)
        return plan(request, spp, *kernels)

    integrator.plan_learning = remembered
    integrator.render(_scene(), spp=5000)
    assert asked == [5000, 99]
    assert clock.now == pytest.approx(10, rel=0.05)


def test_a_wrapper_measures_the_speed_as_its_nested_integrator_does():
    """Otherwise, its pilots are planned for samples that never come."""
    inner, scene = _integrator("auto_path"), _scene()
    outer = mi.load_dict({"type": "adaptive", "nested": inner})
    request = Request(scene, scene.sensors()[0])
    own, nested = (x.pace_stage(request, 5000) for x in (outer, inner))
    assert type(own.estimator) is type(nested.estimator)


def test_a_schedule_that_changes_another_one_ends_its_learning_and_divides_it() -> None:
    class Inner(OneStage):
        ended = 0

        def divide_first_stage(self, pixel_count: int) -> int:
            return pixel_count // 2

        def end_learning(self) -> None:
            self.ended += 1

    class Heavier(ChangedSchedule):
        def changed(self, stage: Stage) -> Stage:
            return replace(stage, weight=2.0)

    inner = Inner(None)
    schedule = Heavier(inner)
    schedule.end_learning()
    assert schedule.divide_first_stage(8) == 4 and inner.ended == 1
    assert schedule.next_stage().weight == 2


@pytest.mark.parametrize(("timeout", "compiling"), [(1.0, 0.0), (10.0, 0.5)])
def test_nothing_is_learned_where_it_would_take_too_long(monkeypatch, timeout, compiling):
    _Clock(monkeypatch, compiling)
    integrator = _integrator("auto_path", timeout=timeout)
    integrator.render(_scene(), spp=5000)
    assert integrator.statistics.learned == "nothing: the time limit is too short"
    assert integrator.statistics.spp > 5


def test_learning_ends_when_it_has_taken_its_share_of_the_time(monkeypatch):
    clock = _Clock(monkeypatch)
    integrator = _integrator("auto_path", timeout=10.0)
    schedule, passes = integrator.schedule, []
    run_stage = rendering.Job._run_stage

    def slow(*arguments):
        made = schedule(*arguments)
        next_stage = made.next_stage

        def delayed():
            clock.now += 1.0
            return next_stage()

        made.next_stage = delayed
        return made

    def run(job, stage, samples, is_last, interrupt):
        passes.append(is_last)
        run_stage(job, stage, samples, is_last, interrupt)

    integrator.schedule = slow
    monkeypatch.setattr(rendering.Job, "_run_stage", run)
    integrator.render(_scene(), spp=5000)
    # There would be three or four pilots
    assert passes == [False, False, True]
    assert integrator.statistics.learned and not integrator.statistics.interrupted


def test_the_samples_that_measure_the_speed_are_part_of_the_image(monkeypatch):
    _Clock(monkeypatch)
    scene = _scene()
    timed = _integrator("auto_path", timeout=20.0).render(scene, spp=5000, seed=3).numpy()
    path = _integrator("composed_path").render(scene, spp=512, seed=4).numpy()
    assert timed.mean() == pytest.approx(path.mean(), rel=0.03)


@pytest.mark.parametrize("spp", [5, 6, 8, 24])
def test_a_timeout_never_adds_samples(monkeypatch, spp):
    _Clock(monkeypatch, 0.5)
    monkeypatch.setattr(pace, "_SHORT_PASS", 5 * 256)
    scene = _scene()
    integrator = _integrator("auto_path", timeout=100.0)
    integrator.render(scene, spp=spp)
    assert integrator.statistics.spp == spp


def test_without_a_timeout_the_plan_is_made_for_all_samples(monkeypatch):
    def never(*_):
        raise AssertionError

    monkeypatch.setattr(pace.time, "perf_counter", lambda: 0.0)
    integrator = _integrator("auto_path")
    integrator.pace_stage = never
    integrator.render(_scene(), spp=16)
    assert integrator.statistics.spp == 16


# ---- Kernels ----


def _large_kernels(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> Counter[str]:
    """How often a render launches each of its large kernels."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        integrator.render(scene, spp=spp, seed=1)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    return Counter(k["hash"] for k in kernels if k["operation_count"] > 1000)


def test_all_pilots_share_a_kernel():
    integrator = _integrator("pss_guided", always_guide=True, max_depth=6)
    # Those of the scout, of three pilots, and of the last stage
    assert sorted(_large_kernels(_scene(), integrator, 64).values()) == [1, 1, 3]


def test_the_light_walk_has_one_kernel(monkeypatch):
    glass = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}}
    kernels = _large_kernels(_scene(glass=glass), _integrator("vcm", max_depth=8), 4)
    # In the pass, and for the radius
    assert max(kernels.values()) == 2
    # Two rounds each
    monkeypatch.setattr(light_walk, "STRIDE", 4)
    kernels = _large_kernels(_scene(glass=glass), _integrator("vcm", max_depth=8), 4)
    assert max(kernels.values()) == 4


def test_learning_begins_only_where_there_is_time_to_compile():
    integrator, scene = _integrator("auto"), _scene()
    film = {"type": "hdrfilm", "width": 256, "height": 256}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    request = Request(scene, sensor)
    plans = [integrator.plan_learning(request, 64, kernels) for kernels in (20, 8, 4)]
    assert [(bool(plan.pilots), plan.tries) for plan in plans] == [
        (True, True), (True, False), (False, False)
    ]


@pytest.mark.parametrize("name", ["auto_path", "auto", "pss_guided", "neepp"])
def test_passes_of_other_lengths_compile_no_kernels(name):
    scene, compiled = _scene(), []
    for spp in (32, 64, 48, 80):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            _integrator(name).render(scene, spp=spp, seed=1)
            kernels = dr.kernel_history([dr.KernelType.JIT])
        new = [k for k in kernels if k["cache_disk"] or not k["cache_hit"]]
        compiled.append([k["operation_count"] for k in new if k["operation_count"] > 1000])
    assert not compiled[2] and not compiled[3]


def test_the_mean_of_the_channels_agrees_with_drjit():
    colour = mi.Color3f([1, 4], [2, 5], [6, 0])
    np.testing.assert_allclose(channel_mean(colour).numpy(), [3, 3])


def test_lanes_add_to_their_own_places():
    target = dr.zeros(mi.Float, 4)
    for _ in range(2):
        add_own(target, mi.Float(1, 2, 3), mi.UInt32(2, 0, 3), mi.Bool(True, True, False))
    np.testing.assert_array_equal(target.numpy(), [4, 0, 2, 0])


def test_passes_from_which_maps_are_learned_are_short_in_large_films() -> None:
    pixels = 1920 * 1080
    plan = RenderPlan(64, (32, 32), Learning(), pixels, False, 16, 1)
    assert plan.pass_length(32) == 16
    assert plan.pass_length(32, 2 * pixels + 1) == 2
    assert plan.pass_length(32, pixels // 2) == 1
    assert RenderPlan(64, (32, 32), Learning(), pixels, True, 8, 1).pass_length(32, pixels) == 8
