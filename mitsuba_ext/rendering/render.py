"""The ``render()`` that all our integrators share: stages, passes, time budget, film, statistics.

A render is a sequence of *stages*. All but the last are pilots: their samples teach the integrator
something *and* land in the film, with weights that are fixed before the first sample is taken. A
stage is cut into *passes* of bounded size, so that peak memory does not depend on the number of
samples, and all passes of a stage run the same kernel.
"""

from __future__ import annotations

import threading
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.gradients import has_gradients
from ..transport import heroes
from ..transport.frozen import with_recordings
from ..util.arrays import from_numpy
from ..util.spectra import load_tables
from . import camera
from .dither import dithered_parts
from .interrupts import deferred_interrupt, interrupted
from .pace import StageSamples, TimeLimit, plan_for_timeout
from .pass_images import FEWEST_PASSES
from .pass_samples import GradientsError
from .passes import Passes
from .plan import whole_warps
from .request import Request
from .staged import Staged
from .stages import Schedule, Stage
from .statistics import PassTimer
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


class Job(Passes):
    """One call of :func:`render`."""

    #: Whether a stage can take samples of a part of the pixels.
    divides_stages = True

    schedule: Schedule

    def __init__(self, integrator: Staged, request: Request) -> None:
        self.start = time.perf_counter()
        self._kernels = dr.detail.launch_stats()
        dr.detail.malloc_clear_statistics()
        super().__init__(integrator, request)
        self.limit = TimeLimit(
            request.timeout, self.start, self.plan.pixel_count, sum(self.plan.stages[:-1])
        )

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
                discards = False
                self.forget()
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
