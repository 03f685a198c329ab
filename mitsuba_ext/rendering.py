"""The one ``render()`` of all our integrators: stages, passes, time budget, film, statistics.

A render is a sequence of *stages*. All but the last are pilots: their samples teach the integrator
something *and* land in the film, with weights that are fixed before the first sample is taken (each
sample counts the same). A stage is cut into *passes* of bounded size, so that peak memory does not
depend on the number of samples, and all passes of a stage run the same kernel.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from . import camera

if TYPE_CHECKING:
    from .integrator import WalkIntegrator

#: Samples per pass. Tracing a pass in Python takes 5 to 70 ms (many materials take longest), the
#: pass itself two or three seconds on two CPU cores. A GPU gets longer passes.
_PASS_SAMPLES = {dr.JitBackend.LLVM: 1 << 21, dr.JitBackend.CUDA: 1 << 24}

#: With a time budget, passes are shorter by this factor: they are what it is kept with.
_TIMEOUT_PASS_DIVISOR = 4

_MAX_WAVEFRONT = 1 << 32


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
        interrupted: Did Ctrl-C or :meth:`cancel` end the render early?
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
class _Part:
    """Passes that share an image block. ``planned`` is the weight of the part in the film, in
    samples per pixel, however many samples ``done`` becomes; 0 for the latter."""

    block: mi.ImageBlock
    planned: int = 0
    done: int = 0


def render(
    integrator: WalkIntegrator,
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
        ValueError: There is no such sensor, or the film has more pixels than a wavefront can hold.
        KeyboardInterrupt: Ctrl-C; the film then holds the image of the finished passes.
    """
    if isinstance(sensor, int):
        if not 0 <= sensor < len(scene.sensors()):
            raise ValueError(
                f"there is no sensor {sensor}: the scene has {len(scene.sensors())} sensor(s)"
            )
        sensor = scene.sensors()[sensor]
    job = _Job(integrator, scene, sensor, seed, spp)
    try:
        with _deferred_interrupt() as interrupt:
            job.run(interrupt)
    finally:
        # Also after an exception, the film holds the passes that were finished
        job.fill_film()
    film = sensor.film()
    image = film.develop() if develop else mi.TensorXf()
    if not develop:
        film.schedule_storage()
    if evaluate:
        dr.eval(image) if develop else dr.eval()
        dr.sync_thread()
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
        self.seed = int(seed if isinstance(seed, int) else seed[0]) & 0xFFFFFFFF
        self.sampler = sensor.sampler().clone()
        if spp:
            self.sampler.set_sample_count(spp)
        self.spp = self.sampler.sample_count()
        self.width, self.height = camera.film_extent(self.film)
        if self.width * self.height >= _MAX_WAVEFRONT:
            raise ValueError(
                f"a film of {self.width}x{self.height} pixels exceeds the 2^32 samples of one pass"
            )
        self.statistics = integrator.statistics = RenderStatistics()
        self.tally = dr.zeros(mi.UInt64, 4)
        self.parts: list[_Part] = []
        self.film.prepare(integrator.aov_names())
        self._plan()

    def _plan(self) -> None:
        """Decides the samples of each stage and of each of its passes."""
        limit = _PASS_SAMPLES[dr.backend_v(mi.Float)] // (self.width * self.height)
        if self.integrator.timeout > 0:
            limit //= _TIMEOUT_PASS_DIVISOR
        limit = max(1, limit)
        stages = self.integrator.stage_samples(self.scene, self.spp)
        # Independent samples can be cut anywhere, and each pass gets a seed of its own. Samples
        # that are stratified over the whole render must come in passes of equal length.
        self.structured = self.sampler.class_name() != "IndependentSampler"
        if self.structured:
            longest = min(limit, *stages)
            length = max(d for d in range(1, longest + 1) if self.spp % d == 0)
            stages = [length * (s // length) for s in stages]
            stages[-1] += self.spp - sum(stages)
            self.sampler.set_samples_per_wavefront(length)
            self.sampler.seed(dr.opaque(mi.UInt32, self.seed), self._lanes(length))
        self.plan = []
        for samples in stages:
            longest = length if self.structured else _even_length(samples, limit)
            passes, rest = divmod(samples, longest)
            self.plan.append([longest] * passes + ([rest] if rest else []))
        self.pass_index = 0

    def _lanes(self, spp: int) -> int:
        return self.width * self.height * spp

    def run(self, interrupt: threading.Event) -> None:
        stage_samples = [sum(passes) for passes in self.plan]
        pass_count = sum(len(passes) for passes in self.plan)
        mi.Log(
            mi.LogLevel.Info,
            f"Starting render job ({self.width}x{self.height}, {self.spp} samples, "
            f"{len(self.plan)} stage(s), {pass_count} pass(es))",
        )
        self._open_part()
        stages = self.integrator.stages(self.scene, stage_samples)
        for index, (stage, passes) in enumerate(zip(stages, self.plan)):
            is_last = index == len(self.plan) - 1
            self.statistics.learned = stage.learned
            if is_last:
                self.statistics.learning_seconds = time.perf_counter() - self.start
            self._run_stage(stage, passes, is_last, interrupt)
            if self._stopped(interrupt):
                self.statistics.interrupted = True
                return

    def _run_stage(self, stage, passes: list[int], is_last: bool, interrupt) -> None:
        timeout = self.integrator.timeout
        is_timed = is_last and timeout > 0
        allowed = len(passes)
        seconds = 0.0
        if is_timed:
            # All passes, unless more of them are allowed below
            self._open_part(planned=sum(passes))
        for index, spp in enumerate(passes):
            if index >= allowed or self._stopped(interrupt):
                return
            if is_timed and index == 1:
                # The number of the remaining passes is decided here, from the speed of the first.
                # The weights stay what they were planned to be, so that the image's mean does not
                # depend on how many of them the time allows.
                remaining = timeout - (time.perf_counter() - self.start)
                allowed = 1 + max(0, int(remaining / max(seconds, 1e-3)))
                if allowed == 1:
                    return
                self.parts[-1].planned = passes[0]
                self._open_part(planned=sum(passes[1:]))
            seconds = self._run_pass(stage, spp)
            if self.integrator.progress is not None:
                self.integrator.progress(self._fraction(allowed, passes, is_timed))

    def _fraction(self, allowed: int, passes: list[int], is_timed: bool) -> float:
        total = self.spp - (sum(passes[allowed:]) if is_timed else 0)
        return min(1.0, self.statistics.spp / total)

    def _open_part(self, planned: int = 0) -> None:
        self.parts.append(_Part(self.film.create_block(), planned))

    def _stopped(self, interrupt: threading.Event) -> bool:
        return interrupt.is_set() or self.integrator.is_cancelled

    def _run_pass(self, stage, spp: int) -> float:
        """Renders ``spp`` samples per pixel into the current part; returns the seconds it took,
        without those of compilation."""
        begin = time.perf_counter()
        sampler = self._pass_sampler(spp)
        ray, weight, position = camera.sample_rays(self.sensor, sampler, spp, self.spp)
        sample = stage.walk(self.scene, sampler, mi.Ray3f(ray), mi.Bool(True))
        aovs = self.integrator.sample_aovs(self.scene, sampler, ray)

        part = self.parts[-1]
        part.block.set_coalesce(part.block.coalesce() and spp >= 4)
        camera.splat(
            self.film, part.block, position, sample.L * weight, sample.valid, ray.wavelengths, aovs
        )
        self._count(sample)
        if self.structured:
            sampler.advance()
            sampler.schedule_state()
        dr.eval(part.block.tensor(), self.tally)
        launched = time.perf_counter()
        dr.sync_thread()
        end = time.perf_counter()

        part.done += spp
        self.pass_index += 1
        self.statistics.passes += 1
        self.statistics.spp += spp
        self.statistics.rays["camera"] += self._lanes(spp)
        self.statistics.compile_seconds += launched - begin
        return end - launched

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
        """Merges the parts into the film, each with its planned weight."""
        for part in self.parts:
            if part.done == 0:
                continue
            tensor = part.block.tensor()
            if part.planned:
                tensor *= part.planned / part.done
            self.film.put_block(part.block)

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


def _even_length(samples: int, limit: int) -> int:
    """The length of passes of about equal length, none above ``limit``."""
    pass_count = -(-samples // limit)
    return max(1, -(-samples // max(1, pass_count)))


@contextlib.contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """While active, the first Ctrl-C only sets the event, so that the running pass can finish; a
    second one interrupts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = signal.getsignal(signal.SIGINT)

    def handler(_signum, _frame) -> None:
        event.set()
        signal.signal(signal.SIGINT, previous)
        mi.Log(mi.LogLevel.Warn, "Interrupted: the running pass is being finished.")

    signal.signal(signal.SIGINT, handler)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)
