"""One render of a scene file: in passes with Mitsuba's integrators, by ``render()`` with ours."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.progress import Progress

from ..compare import timing
from ..images.coverage import Coverage
from ..inputs.chosen import Chosen
from ..rendering.batches import sample_count
from ..rendering.plan import is_independent
from ..rendering.seed_passes import SeedPasses, can_render
from ..rendering.totals import RenderTotals, forget_memory_peak
from ..util.errors import InputError, one_line
from .reports import Report, Speed, time_left

if TYPE_CHECKING:
    from ..live.viewer import Viewer


class RenderJob:
    """The render of a scene by an integrator, and its progress.

    Attributes:
        chosen: The scene, integrator and sensor.
        integrator, name, parameters: The integrator, its name and its parameters.
        scene, sensor: The scene and the sensor that it renders.
        film: The film that holds the image.
        is_interrupted: Whether a signal ended the render before all samples were taken.
        failure: Always ``None``, because a failed render leaves no image.
        seconds: Wall clock time of the render.
        viewer: Is shown the image while it is rendered; ``None`` for nobody.
    """

    def __init__(self, chosen: Chosen, seed: int) -> None:
        named = chosen.named
        self.integrator, self.name, self.parameters = (
            named.integrator, named.name, named.parameters
        )  # fmt: skip
        self.scene, self.sensor, self.film = chosen.scene, chosen.sensor, chosen.sensor.film()
        self.is_interrupted, self.seconds, self.failure = False, 0.0, None
        self.chosen, self._seed = chosen, seed
        self._wanted: int | None = None  # samples per pixel to render, if known
        self._is_measuring = False
        self._passes: SeedPasses | None = None
        self.viewer: Viewer | None = None

    def run(
        self, spp: int | None, seconds: float | None, _write: Callable[[bool], None], report: Report
    ) -> None:
        """Renders ``spp`` samples per pixel (by default, the sampler's number), or as many as fit
        into ``seconds``, and reports the progress. After Ctrl-C, a render in passes ends with
        :attr:`is_interrupted` set; integrators that do not handle it raise ``KeyboardInterrupt``.

        Raises:
            InputError: The integrator cannot render this scene.
            KeyboardInterrupt: Ctrl-C was pressed. :meth:`has_image` says whether the film holds
                samples, :meth:`is_complete` whether it holds all of them.
        """
        begin = time.perf_counter()
        forget_memory_peak()
        try:
            with report.bars() as bars:
                if can_render(self.integrator):
                    self._passes = SeedPasses(
                        self.integrator, self.scene, self.sensor, self._seed
                    )
                if seconds is not None and getattr(self.integrator, "checkpoint", ""):
                    raise ValueError(
                        '--time would measure what "checkpoint" keeps: give the integrator a '
                        '"timeout" instead'
                    )
                if seconds is not None and not self._can_plan():
                    spp, seconds = self._measured(seconds, bars), None
                    begin = time.perf_counter()
                self._render(spp, seconds, bars, report)
        except (ValueError, TypeError, RuntimeError) as error:
            message = f'{self.chosen.loaded.source}: "{self.name}": {one_line(error)}'
            raise InputError(message) from error
        finally:
            self.seconds = time.perf_counter() - begin

    def _can_plan(self) -> bool:
        """Whether the number of samples can be computed from the time during the render."""
        if self._passes is not None:
            return is_independent(self.sensor)
        return timing.plans_for_time(self.integrator, self.scene, self.chosen.sensor_index)

    def _measured(self, seconds: float, bars: Progress) -> int:
        self._is_measuring = True
        bar = bars.add_task("measuring the speed", total=None, left="")
        spp = timing.samples_for(
            seconds, self.integrator, self.scene, self._seed, self.chosen.sensor_index
        )
        bars.remove_task(bar)
        self._is_measuring = False
        return spp

    def _render(
        self, spp: int | None, seconds: float | None, bars: Progress, report: Report
    ) -> None:
        bar = bars.add_task(self.name, total=None, left="")
        begin, speed = time.perf_counter(), Speed()

        def progress(done: float) -> None:
            if seconds is not None and self._passes is None:
                # The reported fraction refers to more samples than will be taken
                done = min(1.0, (time.perf_counter() - begin) / seconds)
            per_second = speed(done)
            left = (1 - done) / per_second if per_second else None
            text, samples = self.name, None
            if per_second and self._wanted:
                samples = per_second * self._wanted * math.prod(self.film.crop_size())
                text += f", {samples / 1e6:.3g} million samples/s"
            bars.update(
                bar, description=text, total=1.0, completed=done, left=time_left(left)
            )
            report.progress(
                done=done, spp=self._passes.spp if self._passes else None, goal_spp=self._wanted,
                samples_per_second=samples, seconds=time.perf_counter() - begin, seconds_left=left,
            )  # fmt: skip

        self._wanted = spp
        if seconds is None:
            self._wanted = sample_count(self.sensor, spp or 0)
        if self._passes is not None:
            self._passes.run(self._wanted or 0, seconds, progress, self.viewer)
            self.is_interrupted = self._passes.interrupted
            return
        if hasattr(self.integrator, "progress"):
            self.integrator.progress = progress
        if self.viewer and hasattr(self.integrator, "watch"):
            self.integrator.watch = self.viewer
        index = self.chosen.sensor_index
        try:
            if seconds is not None:
                timing.render_for(seconds, self.integrator, self.scene, self._seed, index)
            else:
                timing.timed_render(self.integrator, self.scene, self._seed, spp or 0, index)
        finally:
            if self.viewer and hasattr(self.integrator, "watch"):
                self.integrator.watch = None

    def show(self, viewer: Viewer) -> None:
        """Shows the image of the film to a viewer."""
        viewer.show(self.film, self.spp or 0, timing.own_statistics(self.integrator))

    def variance(self) -> dict[str, np.ndarray]:
        """The channels with the variance of the image: none, because it is unknown."""
        return {}

    @property
    def coverage(self) -> Coverage | None:
        """What covers each pixel, if the integrator has masks."""
        return getattr(self.integrator, "coverage", None)

    def about(self) -> dict[str, Any]:
        """Further metadata of the image: none."""
        return {}

    @property
    def seeds(self) -> list[int]:
        """The seed of the render."""
        return [self._seed]

    @property
    def totals(self) -> RenderTotals:
        """The cost of the render."""
        return RenderTotals.of(self.integrator, self.film, self.spp or 0, self.seconds)

    # ---- The state of the render ----

    @property
    def spp(self) -> int | None:
        """The number of samples per pixel in the image. ``None`` if an interrupted integrator does
        not report it (one neither Mitsuba's nor ours)."""
        report = self._passes or timing.own_statistics(self.integrator)
        if report is not None:
            return report.spp
        return None if self.is_interrupted else sample_count(self.sensor, self._wanted or 0)

    def how_far(self) -> str:
        """The progress, for a message about an interruption."""
        if self.spp is None:
            return "during the render"
        wanted = f" of {self._wanted}" if self._wanted else ""
        return f"after {self.spp}{wanted} spp"

    def is_complete(self) -> bool:
        """Whether the film holds all samples, as after a signal in the last pass. False for
        integrators that do not report it (neither Mitsuba's nor ours)."""
        report = self._passes or timing.own_statistics(self.integrator)
        return report is not None and report.passes > 0 and not report.interrupted

    def has_image(self) -> bool:
        """Whether the film holds samples."""
        if self._is_measuring:
            return False
        report = self._passes or timing.own_statistics(self.integrator)
        if report is not None:
            return report.passes > 0
        try:
            return bool(np.any(self.film.develop(raw=True)))
        except RuntimeError:  # not prepared yet
            return False
