"""The one ``render()`` of all our integrators: stages, passes, time budget, film, statistics.

A render is a sequence of *stages*. All but the last are pilots: their samples teach the integrator
something *and* land in the film, with weights that are fixed before the first sample is taken (each
sample counts the same). A stage is cut into *passes* of bounded size, so that peak memory does not
depend on the number of samples, and all passes of a stage run the same kernel.
"""

from __future__ import annotations

import operator
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..parameters import MOST_SPP
from ..transport import heroes as dispersion
from ..transport.walk import Walk
from . import camera
from .camera_samples import CameraSamples
from .interrupts import deferred_interrupt
from .time_budget import TimeBudget

if TYPE_CHECKING:
    from .staged_integrator import StagedIntegrator

#: Samples per pass. Tracing a pass in Python takes 5 to 70 ms (many materials take longest), the
#: pass itself two or three seconds on two CPU cores. A GPU gets longer passes.
_PASS_SAMPLES = {dr.JitBackend.LLVM: 1 << 21, dr.JitBackend.CUDA: 1 << 24}

#: Samples per pixel and pass, at least, however large the film is: neighbouring lanes that share a
#: pixel trace rays that stay together. At 1920x1080, passes of one sample take 1.6 times as long.
#: Not with a structured sampler, which keeps a state for each sample of a pass.
_PASS_SPP = 16

#: Passes of a structured sampler that learns, at least: a pilot is one of them or more.
_MIN_STRUCTURED_PASSES = 16

#: With a timeout, passes of a structured sampler are shorter by this factor: they cannot differ in
#: length, and are what the timeout is kept with.
_TIMEOUT_PASS_DIVISOR = 4

_MAX_WAVEFRONT = 1 << 32

#: Passes of a render, at most: they last weeks.
_MOST_PASSES = 1 << 20


@dataclass
class RenderStatistics:
    """What a render did and what it cost.

    Attributes:
        passes: Passes whose samples are in the film.
        spp: Samples per pixel that were taken.
        seconds: Wall clock of the whole call, compilation and learning included.
        compile_seconds: Of these, the time to trace passes and to compile (or load) their kernels.
        learning_seconds: Of these, the time before the last stage began.
        rays: Rays traced, by kind: ``camera``, ``scatter`` (found by sampling a BSDF), ``shadow``.
        connections: Connections to lights that were considered; ``path`` traces a shadow ray for
            each, ours only for those that would contribute and that the shadow test lets through.
        zero_radiance: Share of the camera samples that brought back nothing.
        learned: Summary of what the integrator learned; empty where it learns nothing.
        memory: Peak of the memory that Dr.Jit held during the render, in bytes.
        interrupted: Did Ctrl-C, :meth:`cancel` or an error end the render before all samples were
            taken? Ctrl-C in the last pass does not.
    """

    passes: int = 0
    spp: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    learning_seconds: float = 0.0
    rays: dict[str, int] = field(
        default_factory=lambda: {"camera": 0, "scatter": 0, "shadow": 0}
    )
    connections: int = 0
    zero_radiance: float = 0.0
    learned: str = ""
    memory: int = 0
    interrupted: bool = False


@dataclass
class Stage:
    """One stage of a render.

    Attributes:
        walk: What its samples do.
        learned: What had been learned before.
        is_scout: Does it take one sample per pixel that is none of the image's?
        camera: What chooses points of the aperture, times and wavelengths.
    """

    walk: Walk
    learned: str = ""
    is_scout: bool = False
    camera: CameraSamples = field(default_factory=CameraSamples)


def render(
    integrator: StagedIntegrator,
    scene: mi.Scene,
    sensor: int | mi.Sensor,
    seed: int | mi.UInt32,
    spp: int,
    develop: bool,
    evaluate: bool,
) -> mi.TensorXf:
    """Renders ``scene`` with the estimators that ``integrator.stages()`` yields.

    Parameters are those of ``mi.Integrator.render``. The statistics are left in
    ``integrator.statistics``.

    Raises:
        ValueError: There is no such sensor, ``spp`` is out of range, the film has more pixels than
            a wavefront can hold, or these are too many samples for so many pixels.
        NotImplementedError: The integrator has AOVs, and the film is a special one.
        KeyboardInterrupt: Ctrl-C; the film then holds the image of the finished passes.
    """
    sensor = camera.find_sensor(scene, sensor)
    job = _Job(integrator, scene, sensor, seed, spp)
    try:
        with deferred_interrupt() as interrupt:
            job.run(interrupt)
    finally:
        # Also after an exception, the film holds the passes that were finished
        job.fill_film()
    image = camera.develop(sensor.film(), develop, evaluate)
    job.finish()
    if interrupt.is_set():
        raise KeyboardInterrupt
    return image


class _Job:
    """One call of :func:`render`."""

    def __init__(self, integrator, scene, sensor, seed, spp) -> None:
        self.start = time.perf_counter()
        dr.detail.malloc_clear_statistics()
        self.integrator, self.scene, self.sensor, self.film = (
            integrator, scene, sensor, sensor.film(),
        )
        seed = int(seed[0]) if isinstance(seed, mi.UInt32) else operator.index(seed)
        self.seed = seed & 0xFFFFFFFF
        self.sampler = _own_sampler(sensor)
        if not 0 <= spp <= MOST_SPP:
            raise ValueError(
                f'"{integrator.name}": spp is {spp}; it must be 1 to {MOST_SPP}, or 0 for as many '
                f"as the sampler says"
            )
        if spp:
            self.sampler.set_sample_count(spp)
        self.spp = self.sampler.sample_count()
        self.width, self.height = camera.film_extent(self.film)
        check_extent(self.film)
        self.statistics = integrator.statistics = RenderStatistics()
        self.tally = dr.zeros(mi.UInt64, 4)
        aovs = integrator.aov_names()
        if aovs and mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{integrator.name}": the parameter "aovs" does not work with the film '
                f'"{self.film.class_name()}": use an "hdrfilm".'
            )
        self.film.prepare(aovs)
        self._plan()
        self.block = self.film.create_block()
        # One kernel for all passes: coalescing is decided once
        longest = max(self._pass_length(samples) for samples in self.stages)
        self.block.set_coalesce(self.block.coalesce() and longest >= 4)

    def _plan(self) -> None:
        """Decides the samples of each stage and the length of passes."""
        pixel_count = self.width * self.height
        self.structured = self.sampler.class_name() != "IndependentSampler"
        cost = self.integrator.sample_cost
        limit = _PASS_SAMPLES[dr.backend_v(mi.Float)] // (pixel_count * cost)
        if not self.structured:
            limit = max(limit, min(_PASS_SPP // cost, (_MAX_WAVEFRONT - 1) // pixel_count))
        is_timed = self.integrator.timeout > 0
        if self.structured and is_timed:
            limit //= _TIMEOUT_PASS_DIVISOR
        self.limit = max(1, min(limit, self.integrator.samples_per_pass))
        if self.spp > self.limit * _MOST_PASSES:
            raise ValueError(
                f'"{self.integrator.name}": {self.spp} samples for each of {pixel_count} pixels '
                f"are too many: give at most {self.limit * _MOST_PASSES}"
            )
        pilots = self.integrator.pilots(self.scene, self.spp)
        # With a timeout, sets of samples are kept whole
        self.set_size = self.integrator.samples_per_set(self.spp) if is_timed else 1
        if self.structured:
            pilots = self._plan_structured(pilots)
        self.stages = [*pilots, self.spp - sum(pilots)]
        self.budget = TimeBudget(self.integrator.timeout, self.start, pixel_count, sum(pilots))
        self.pass_index = 0

    def _plan_structured(self, pilots: list[int]) -> list[int]:
        """Independent samples can be cut anywhere, and each pass gets a seed of its own. Samples
        that are stratified over the whole render must come in passes of equal length, to which
        the pilots are rounded."""
        if pilots:
            self.limit = min(self.limit, max(*pilots, self.spp // _MIN_STRUCTURED_PASSES))
        self.limit = length = max(d for d in range(1, self.limit + 1) if self._can_be_cut(d))
        self.sampler.set_samples_per_wavefront(length)
        self.sampler.seed(dr.opaque(mi.UInt32, self.seed), self._lanes(length))
        return [length * max(1, samples // length) for samples in pilots]

    def _can_be_cut(self, length: int) -> bool:
        """Into passes of this length?"""
        if self.spp % length != 0:
            return False
        return self.set_size % length == 0 or length % self.set_size == 0

    def _pass_length(self, samples: int) -> int:
        """Of passes of about equal length that take ``samples`` samples."""
        if self.structured:
            return self.limit
        pass_count = -(-samples // self.limit)
        return max(1, -(-samples // max(1, pass_count)))

    def _lanes(self, spp: int) -> int:
        return self.width * self.height * spp

    def run(self, interrupt: threading.Event) -> None:
        mi.Log(
            mi.LogLevel.Info,
            f"Starting render job ({self.width}x{self.height}, {self.spp} samples, "
            f"{len(self.stages)} stage(s))",
        )
        self.statistics.interrupted = True  # until the last stage has all its samples
        plan = iter(enumerate(self.stages))
        for stage in self.integrator.stages(self.scene, self.sensor, self.stages, self.seed):
            if stage.is_scout:
                self._run_scout(stage)
                continue
            index, samples = next(plan)
            is_last = index == len(self.stages) - 1
            self.statistics.learned = stage.learned
            if is_last:
                samples = self.spp - self.statistics.spp  # pilots may have been cut short
                self.statistics.learning_seconds = time.perf_counter() - self.start
                if stage.camera.wavelength is None:
                    dispersion.warn_of_sampler(self.scene, self.sampler)
            self._run_stage(stage, samples, is_last, interrupt)
            if self._stopped(interrupt):
                return

    def _run_stage(self, stage: Stage, samples: int, is_last: bool, interrupt) -> None:
        """Runs the passes of a stage: all of them, or as many as the timeout allows."""
        before = self.statistics.spp
        budget = self.budget.stage(samples, before, is_last)
        length, done = self._pass_length(samples), 0
        while done < (wanted := self._whole(before, budget.samples, samples)):
            if self._stopped(interrupt):
                return
            spp = length if self.structured else min(length, budget.longest, wanted - done)
            begin = time.perf_counter()
            compiled = self._run_pass(stage, spp)
            done += spp
            if not compiled:
                budget.passed(spp, done, time.perf_counter() - begin)
            if self.integrator.progress is not None:
                is_known = is_last and not budget.is_open
                wanted = max(done, self._whole(before, budget.samples, samples))
                total = before + wanted if is_known else self.spp
                self.integrator.progress((before + done) / total)
        self.statistics.interrupted = not is_last

    def _whole(self, before: int, samples: int, most: int) -> int:
        """The samples of a stage, so many that the render ends with a whole set; ``most`` would do
        so."""
        return min(most, samples + -(before + samples) % self.set_size)

    def _stopped(self, interrupt: threading.Event) -> bool:
        return interrupt.is_set() or self.integrator.is_cancelled

    def _run_scout(self, stage: Stage) -> None:
        begin = time.perf_counter()
        sampler = mi.load_dict({"type": "independent"})
        # The same for all seeds: what a scout decides changes the size of tables, and kernels
        sampler.seed(dr.opaque(mi.UInt32, 0), self._lanes(1))
        rays = camera.sample_rays(self.sensor, sampler, 1, self.spp, stage.camera)
        sample = stage.walk(self.scene, sampler, rays.ray, mi.Bool(True), rays.pixel)
        dr.eval(sample.L)
        self.statistics.compile_seconds += time.perf_counter() - begin
        dr.sync_thread()

    def _run_pass(self, stage: Stage, spp: int) -> bool:
        """Renders ``spp`` samples per pixel into the block; did it have to compile a kernel?"""
        begin = time.perf_counter()
        misses = kernel_cache_misses()
        sampler = self._pass_sampler(spp)
        rays = camera.sample_rays(
            self.sensor, sampler, spp, self.spp, stage.camera, self.statistics.spp
        )
        sample = stage.walk(
            self.scene, sampler, rays.ray, mi.Bool(True), rays.pixel, rays.hero_weight
        )
        if dr.grad_enabled(sample.L):
            raise self.integrator.no_gradients()
        aovs = [*sample.aovs, *self.integrator.sample_aovs(self.scene, sampler, rays.ray)]
        camera.splat(self.film, self.block, rays, sample.L, sample.valid, aovs)
        self._count(sample)
        if self.structured:
            sampler.advance()
            sampler.schedule_state()
        dr.eval(self.block.tensor(), self.tally)
        self.statistics.compile_seconds += time.perf_counter() - begin
        dr.sync_thread()

        self.pass_index += 1
        self.statistics.passes += 1
        self.statistics.spp += spp
        self.statistics.rays["camera"] += self._lanes(spp)
        return kernel_cache_misses() > misses

    def _pass_sampler(self, spp: int) -> mi.Sampler:
        if self.structured:
            return self.sampler
        # The first pass is seeded as Mitsuba's own integrators do: it draws the same numbers
        seed = self.seed
        if self.pass_index > 0:
            seed = mi.sample_tea_32(mi.UInt32(self.seed), mi.UInt32(self.pass_index))[0][0]
        sampler = self.sampler.clone()
        sampler.seed(dr.opaque(mi.UInt32, seed), self._lanes(spp))
        return sampler

    def _count(self, sample) -> None:
        counts = (
            sample.scatter_count,
            sample.shadow_count,
            sample.connection_count,
            dr.select(dr.max(dr.abs(sample.L)) == 0, 1, 0),
        )
        for index, count in enumerate(counts):
            dr.scatter_add(self.tally, mi.UInt64(count), mi.UInt32(index))

    def fill_film(self) -> None:
        """Hands the samples of the finished passes to the film."""
        self.film.put_block(self.block)

    def finish(self) -> None:
        statistics = self.statistics
        scatter, shadow, connections, black = (int(n) for n in self.tally.numpy())
        statistics.rays.update(scatter=scatter, shadow=shadow)
        statistics.connections = connections
        statistics.zero_radiance = black / max(1, statistics.rays["camera"])
        statistics.memory = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
        statistics.seconds = time.perf_counter() - self.start
        mi.Log(
            mi.LogLevel.Info,
            f"Rendering {'interrupted' if statistics.interrupted else 'finished'}. "
            f"(took {statistics.seconds:.2f}s, {statistics.passes} pass(es), "
            f"{statistics.spp} of {self.spp} samples)",
        )


def check_extent(film: mi.Film) -> None:
    """Refuses a film that one pass cannot fill.

    Raises:
        ValueError: It has more pixels than a wavefront can hold.
    """
    width, height = camera.film_extent(film)
    if width * height >= _MAX_WAVEFRONT:
        raise ValueError(
            f"a film of {width}x{height} pixels exceeds the 2^32 samples of one pass"
        )


def _own_sampler(sensor: mi.Sensor) -> mi.Sampler:
    """A copy of the sensor's sampler, or the sampler itself where it cannot be copied (samplers
    written in Python need not have ``clone``)."""
    try:
        return sensor.sampler().clone()
    except RuntimeError:
        return sensor.sampler()


def kernel_cache_misses() -> int:
    """How many kernels have been compiled, or loaded from the disk, in this process."""
    _launches, soft_misses, hard_misses = dr.detail.launch_stats()
    return soft_misses + hard_misses
