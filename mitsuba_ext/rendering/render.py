"""The ``render()`` that all our integrators share: stages, passes, time budget, film, statistics.

A render is a sequence of *stages*. All but the last are pilots: their samples teach the integrator
something *and* land in the film, with weights that are fixed before the first sample is taken. A
stage is cut into *passes* of bounded size, so that peak memory does not depend on the number of
samples, and all passes of a stage run the same kernel.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.gradients import has_gradients
from ..transport import heroes
from ..transport.estimator import CameraRays, Sample
from ..transport.frozen import with_recordings
from ..util.arrays import from_numpy
from ..util.spectra import load_tables
from . import camera
from .device import device_of, look_again
from .dither import dithered_parts
from .filter_weights import put_splats
from .interrupts import deferred_interrupt, interrupted
from .mask_samples import MaskSamples
from .pace import StageSamples, TimeLimit, plan_for_timeout
from .pass_images import FEWEST_PASSES
from .pass_samples import GradientsError, count_rays, look, put_samples, recorded
from .plan import plan_render, whole_warps
from .request import Request
from .staged import Staged
from .stages import Schedule, Stage
from .statistics import PassTimer, RenderStatistics
from .turns import let_others, tell


def render(integrator: Staged, request: Request, job: type[Job] | None = None) -> mi.TensorXf:
    """Renders a scene with the estimators that ``integrator.schedule()`` makes. The statistics are
    left in ``integrator.statistics``.

    Parameters:
        job: The class that distributes the samples, if pixels do not get equal numbers.

    Raises:
        ValueError: ``spp`` is out of range, the film has more pixels than a wavefront can hold, or
            ``spp`` is too large for this number of pixels.
        NotImplementedError: The integrator has AOVs, and the film is a special one; or parameters
            of the scene have gradients.
        KeyboardInterrupt: Ctrl-C; the film then holds the image of the finished passes.
    """
    scene, sensor = request.scene, request.sensor
    if request.job is not None and job is not None:
        raise NotImplementedError(
            f'"{integrator.name}" distributes its samples itself: replay the integrator that is '
            f"nested in it"
        )

    def attempt() -> tuple[Job, threading.Event]:
        made = (request.job or job or Job)(integrator, request)
        try:
            with deferred_interrupt() as interrupt:
                made.run(interrupt)
        finally:
            # Also after an exception, the film holds the passes that were finished
            made.fill_film()
        return made, interrupt

    load_tables()
    try:
        made, interrupt = with_recordings(scene, sensor, attempt)
    except GradientsError:
        if has_gradients(scene, sensor):
            raise integrator.no_gradients() from None
        # Another scene has them: Dr.Jit traces the methods of all BSDFs and lights in memory
        with dr.suspend_grad():
            made, interrupt = with_recordings(scene, sensor, attempt)
    image = camera.develop(sensor.film(), request.develop, request.evaluate)
    if made.masks is not None:
        integrator.coverage = made.masks.coverage()
    made.finish()
    if interrupt.is_set():
        raise interrupted(integrator.name)
    made.schedule.finish(made.statistics)
    return image


class Job:
    """One call of :func:`render`."""

    #: Whether a stage can take samples of a part of the pixels.
    divides_stages = True

    #: Whether a whole pass may be recorded (``frozen.py``). False if a subclass reads the samples.
    freezes_passes = True

    schedule: Schedule

    def __init__(self, integrator: Staged, request: Request) -> None:
        self.start = time.perf_counter()
        self._kernels = dr.detail.launch_stats()
        dr.detail.malloc_clear_statistics()
        self.integrator, self.request = integrator, request
        self.scene, self.sensor, self.film = request.scene, request.sensor, request.sensor.film()
        self.sampler = camera.own_sampler(self.sensor)
        look_again()
        self.plan = plan_render(integrator, request, self.sampler, device_of(mi.Float))
        self.statistics = integrator.statistics = RenderStatistics()
        self.tally = dr.zeros(mi.UInt64, 4)
        aovs = integrator.aov_names()
        if aovs and mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{integrator.name}": the film "{self.film.class_name()}" has no room for more '
                f'channels ("aovs", "count_samples"): use an "hdrfilm".'
            )
        self.film.prepare(aovs)
        self._has_ray_aovs = integrator.has_ray_aovs
        self.masks = None
        if integrator.masks:
            self.masks = MaskSamples(
                integrator.name, self.scene, self.film, integrator.masks, integrator.hide_emitters
            )
        # A single part has no range, so that kernels need not add its first pixel
        self.parts = [None] if self.plan.parts == 1 else self.plan.pixels
        # Structured samplers, one for each part of the film, which keep their state between passes
        self.samplers: list[mi.Sampler] = []
        if self.plan.structured:
            self.samplers = [self.sampler, *(self.sampler.clone() for _ in self.parts[1:])]
            for index, sampler in enumerate(self.samplers):
                sampler.set_samples_per_wavefront(self.plan.limit)
                self._seed(sampler, index, self.plan.limit, self.parts[index])
        self.limit = TimeLimit(
            request.timeout, self.start, self.plan.pixel_count, sum(self.plan.stages[:-1])
        )
        self.block, self.splats = self.film.create_block(), None
        # One kernel for all passes: coalescing is decided once
        self.block.set_coalesce(self.block.coalesce() and self.plan.longest_pass >= 4)
        # Samples per pixel that are not part of the image, and the sum of the weights of the others
        self.forgotten, self.weight = 0, 0.0

    def _lanes(self, spp: int, pixels: range | np.ndarray | None = None) -> int:
        return (self.plan.pixel_count if pixels is None else len(pixels)) * spp

    def _seed(
        self, sampler: mi.Sampler, index: int, spp: int, pixels: range | np.ndarray | None
    ) -> None:
        """Seeds a sampler for part ``index``, counted over all passes. The first one is seeded as
        in Mitsuba's own integrators, so that it draws the same numbers."""
        seed = mi.UInt32(self.request.seed)
        if index > 0:
            seed = mi.sample_tea_32(seed, mi.UInt32(index))[0]
        dr.make_opaque(seed)
        camera.tell_film(sampler, self.film, getattr(pixels, "start", 0))
        sampler.seed(seed, self._lanes(spp, pixels))

    def run(self, interrupt: threading.Event) -> None:
        mi.Log(
            mi.LogLevel.Info,
            f"Starting render job ({self.plan.pixel_count} pixels, {self.plan.spp} samples, "
            f"{len(self.plan.stages)} stage(s))",
        )
        self.statistics.interrupted = True  # until the last stage has all its samples
        plan = self.plan = plan_for_timeout(self)
        schedule = self.schedule = self.integrator.schedule(
            self.request, plan.stages, plan.learning
        )
        parts = self._first_parts(schedule)
        for index, samples in enumerate(plan.stages):
            if index == 0 and parts:
                self._run_divided(schedule, parts)
                if self._stopped(interrupt):
                    return
                continue
            is_last = index == len(plan.stages) - 1
            # The first two pilots find out what can be learned, and test it
            if index >= 2 and self.limit.ends_learning(0 if is_last else samples):
                schedule.end_learning()
                if not is_last:
                    continue
            stage = self._next_stage(schedule)
            self.statistics.learned = stage.learned
            self.statistics.effects = dict(stage.effects)
            if is_last:
                samples = plan.spp - self.statistics.spp  # pilots may have been cut short
                self.statistics.learning_seconds = time.perf_counter() - self.start
                if stage.camera.wavelength is None:
                    heroes.warn_of_sampler(self.scene, self.sampler)
            self._run_stage(stage, samples, is_last, interrupt)
            if self._stopped(interrupt):
                return

    def _run_stage(self, stage: Stage, samples: int, is_last: bool, interrupt) -> None:
        """Runs the passes of a stage: all of them, or as many as the timeout allows."""
        before = self.statistics.spp
        known = StageSamples(self.limit, samples, before, is_last)
        discards = stage.discards_earlier
        length, done = self.plan.pass_length(samples, stage.most_lanes), 0
        if stage.images is not None and not self.plan.structured:
            length = min(length, max(1, samples // FEWEST_PASSES))
            length = whole_warps(length, self.plan.warp)
        while done < (wanted := self.plan.whole(before, known.samples, samples)):
            if self._stopped(interrupt):
                return
            spp = length if self.plan.structured else min(length, known.longest, wanted - done)
            timer = PassTimer()
            if discards:
                # Not before there are others
                discards, self.forgotten, self.weight = False, before, 0.0
                self.block.clear()
                self.splats = None
                if self.masks is not None:
                    self.masks.clear()
            if stage.images is not None and done == 0:
                stage.images.begin(self.block, self.splats, before)
            compiled = self.run_pass(stage, spp)
            done += spp
            if stage.images is not None:
                stage.images.add(self.block, self.splats, before + done, stage.weight)
            if not compiled:
                known.passed(spp, done, timer.seconds)
            self._show()
            if self.request.progress is not None:
                is_known = is_last and not known.is_open
                wanted = max(done, self.plan.whole(before, known.samples, samples))
                total = before + wanted if is_known else self.plan.spp
                tell(self.request.progress, (before + done) / total)
        self.statistics.interrupted = not is_last

    def _next_stage(self, schedule: Schedule) -> Stage:
        while (stage := schedule.next_stage()).is_scout:
            self._run_scout(stage)
        return stage

    def _first_parts(self, schedule: Schedule) -> list[np.ndarray]:
        """The pixels of each stage into which the schedule divides the first one; an empty list if
        it is not divided."""
        if not self.divides_stages or self.plan.structured or self.plan.parts > 1:
            return []
        count = schedule.divide_first_stage(self.plan.pixel_count)
        return dithered_parts(*camera.film_extent(self.film), count) if count > 1 else []

    def _run_divided(self, schedule: Schedule, parts: list[np.ndarray]) -> None:
        """Takes one sample of each pixel, in a stage for each part of them."""
        for pixels in parts:
            stage, timer = self._next_stage(schedule), PassTimer()
            sampler = self.sampler.clone()
            self._seed(sampler, self.statistics.passes, 1, pixels)
            pixel = from_numpy(mi.UInt32, pixels)
            lanes = camera.lanes_at(self.film, pixel, dr.opaque(mi.UInt32, 0))
            self._take(stage, sampler, lanes)
            self._add_tracing(timer)
            dr.sync_thread()
            self.statistics.passes += 1
            self.statistics.rays["camera"] += len(pixels)
            self.weight += stage.weight * len(pixels) / self.plan.pixel_count
        self.statistics.spp += 1

    def _stopped(self, interrupt: threading.Event) -> bool:
        """Whether to stop. Called between passes, where other threads get their turn."""
        let_others()
        return interrupt.is_set() or self.integrator.is_cancelled

    def _run_scout(self, stage: Stage) -> None:
        timer = PassTimer()
        for pixels in self.parts if stage.pixels is None else [stage.pixels]:
            self._scout(stage, pixels)
        self._add_tracing(timer)
        dr.sync_thread()

    def _scout(self, stage: Stage, pixels: range | np.ndarray | None) -> None:
        sampler = mi.load_dict({"type": "independent"})
        # The same numbers for all seeds: the decisions of a scout change sizes of tables, and with
        # them the kernels. Images of different seeds are independent: none of these samples is a
        # part of them
        number = 0 if stage.pixels is not None or pixels is None else pixels.start
        sampler.seed(dr.opaque(mi.UInt32, number), self._lanes(1, pixels))
        if stage.pixels is None:
            lanes = camera.PassLanes.of(self.film, 1, 0, pixels)
        else:
            lanes = camera.PixelLanes(from_numpy(mi.UInt32, pixels))
        self._begin(stage, lanes)
        if self._is_frozen(stage):
            radiance = look(
                stage.estimator, stage.camera, self.scene, self.sensor, sampler, lanes,
                self.plan.spp,
            )  # fmt: skip
        else:
            rays = self._rays(stage, sampler, lanes.lanes(self.film))
            radiance = stage.estimator(self.scene, sampler, rays, mi.Bool(True)).L
        dr.eval(radiance)

    def _begin(self, stage: Stage, lanes: camera.PassLanes) -> None:
        """Tells the observer of a stage, if there is one, the pixels of the next samples."""
        if stage.observer is not None:
            pixel = lanes.lanes(self.film).pixel
            dr.eval(pixel)
            stage.observer.begin(lanes.count, pixel)

    def run_pass(self, stage: Stage, spp: int) -> bool:
        """Renders ``spp`` samples per pixel into the block. Returns True if it compiled a
        kernel."""
        timer = PassTimer()
        for part in range(len(self.parts)):
            self._run_part(stage, spp, part)
        self._add_tracing(timer)
        dr.sync_thread()

        self.statistics.passes += 1
        self.statistics.spp += spp
        self.weight += stage.weight * spp
        self.statistics.rays["camera"] += self._lanes(spp)
        return timer.has_new_kernels

    def _add_tracing(self, timer: PassTimer) -> None:
        self.statistics.add_tracing(timer.seconds, timer.has_compiled)

    def _run_part(self, stage: Stage, spp: int, part: int) -> None:
        sampler, pixels = self._part_sampler(spp, part), self.parts[part]
        lanes = camera.PassLanes.of(self.film, spp, self.statistics.spp, pixels)
        if not self._is_frozen(stage):
            if self._is_walk_frozen(stage) and stage.observer is None:
                stage = replace(stage, estimator=recorded(stage.estimator))
            self._take(stage, sampler, lanes.lanes(self.film))
            return
        self._begin(stage, lanes)
        weight = 1.0 if stage.weight == 1 else dr.opaque(mi.Float, stage.weight)
        labelled = put_samples(
            stage.estimator, stage.camera, self.scene, self.sensor, sampler, lanes,
            self.plan.spp, weight, self.block, self.tally, self.masks and self.masks.labels,
        )  # fmt: skip
        if labelled is not None:
            self.masks.taken.append(labelled)
        self._finish_take(sampler)

    def _is_frozen(self, stage: Stage) -> bool:
        """Whether the passes of this stage are recorded (``frozen.py``)."""
        return not self._has_ray_aovs and self._is_walk_frozen(stage)

    def _is_walk_frozen(self, stage: Stage) -> bool:
        """Whether the estimator of this stage is recorded, if not the whole pass."""
        if not self.freezes_passes:
            return False
        if stage.observer is not None and not stage.observer.can_be_frozen:
            return False
        # Special films may run any code when they prepare samples
        is_special = mi.has_flag(self.film.flags(), mi.FilmFlags.Special)
        return not is_special and getattr(stage.estimator, "can_be_frozen", False)

    def _take(self, stage: Stage, sampler: mi.Sampler, lanes: camera.Lanes) -> None:
        """Puts the samples of these lanes into the block."""
        rays = self._rays(stage, sampler, lanes)
        count = stage.weight if stage.weight == 1 else dr.opaque(mi.Float, stage.weight)
        sample = self._sample(stage, sampler, rays, count)
        for splats in sample.splats:
            if self.splats is None:
                self.splats = self.film.create_block()
                self.splats.set_coalesce(False)
            camera.put_splats(self.film, self.splats, splats, count)
        self._finish_take(sampler)

    def _rays(self, stage: Stage, sampler: mi.Sampler, lanes: camera.Lanes) -> CameraRays:
        numbers = camera.draw_numbers(self.sensor, sampler, lanes, stage.camera)
        return camera.camera_rays(self.sensor, lanes, numbers, self.plan.spp)

    def _finish_take(self, sampler: mi.Sampler) -> None:
        if self.plan.structured:
            sampler.advance()
            sampler.schedule_state()
        self._evaluate(self.splats and self.splats.tensor())

    def _evaluate(self, *others: Any) -> None:
        """Evaluates the samples of a pass, and ``others`` in the same kernel."""
        dr.eval(self.block.tensor(), self.tally, *others, self.masks and self.masks.taken)
        if self.masks is not None:
            self.masks.put()

    def _sample(
        self, stage: Stage, sampler: mi.Sampler, rays: CameraRays, count: mi.Float | float = 1.0
    ) -> Sample:
        """Puts the samples of these rays, without their splats, into the block."""
        if self.masks is not None:
            # Before the samples of the image: a BSDF that is asked for its transmission may read
            # an array on the host, which evaluates the samples in the block so far
            self.masks.taken.append(self.masks.labels.of(self.scene, rays, count))
        if stage.observer is not None:
            stage.observer.begin(dr.width(rays.ray), rays.pixel)
        sample = stage.estimator(self.scene, sampler, rays, mi.Bool(True))
        if dr.grad_enabled(sample.L):
            raise GradientsError
        aovs = sample.aovs
        if self._has_ray_aovs:
            aovs = aovs + self.integrator.sample_aovs(self.scene, sampler, rays.ray)
        camera.put(self.film, self.block, rays, sample, aovs, count)
        count_rays(self.tally, sample)
        return sample

    def _part_sampler(self, spp: int, part: int) -> mi.Sampler:
        if self.plan.structured:
            return self.samplers[part]
        sampler = self.sampler.clone()
        index = self.statistics.passes * len(self.parts) + part
        self._seed(sampler, index, spp, self.parts[part])
        return sampler

    def fill_film(self) -> None:
        """Adds the samples of the finished passes to the film."""
        self.film.put_block(self.block)
        if self.splats is not None and self.statistics.spp > 0:
            tensor, offset = self.splats.tensor(), self.splats.offset()
            put_splats(self.film, tensor, offset, self.weight)

    def _show(self) -> None:
        """Shows the image so far, if somebody watches and wants to see it now."""
        watch = self.request.watch
        if watch is not None and watch.is_due():
            block = self.block
            self.fill_film()
            watch.show(self.film, self.statistics.spp - self.forgotten, self.statistics)
            self.film.clear()
            self.block = block  # subclasses put another one into the film

    def finish(self) -> None:
        statistics = self.statistics
        scatter, shadow, connections, black = (int(n) for n in self.tally.numpy())
        statistics.rays.update(scatter=scatter, shadow=shadow)
        statistics.connections = connections
        statistics.zero_radiance = black / max(1, statistics.rays["camera"])
        statistics.memory = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
        statistics.seconds = time.perf_counter() - self.start
        launched = (now - then for now, then in zip(dr.detail.launch_stats(), self._kernels))
        statistics.kernels = dict(zip(("launched", "loaded", "compiled"), launched))
        mi.Log(
            mi.LogLevel.Info,
            f"Rendering {'interrupted' if statistics.interrupted else 'finished'}. "
            f"(took {statistics.seconds:.2f}s, {statistics.passes} pass(es), "
            f"{statistics.spp} of {self.plan.spp} samples)",
        )
