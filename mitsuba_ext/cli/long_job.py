"""A render in batches that can be continued, divided among processes, and ended at a given error.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..images.coverage import Coverage
from ..inputs.chosen import LastScene
from ..live.kept_folder import of_state
from ..long_renders.batch_renderer import BatchRenderer, RenderRequest
from ..long_renders.executors import renderers
from ..long_renders.folder import CheckpointFolder
from ..long_renders.intervals import Interval, LastKept
from ..long_renders.long_render import Goal, LongRender
from ..long_renders.state import RenderState
from ..long_renders.workers import threads_of_each
from ..rendering import interrupts
from ..rendering.batches import sample_count
from ..rendering.interrupts import deferred_interrupt
from ..rendering.totals import RenderTotals
from ..util.errors import InputError
from .long_progress import LongProgress
from .reports import Report

if TYPE_CHECKING:
    from ..live.viewer import Viewer


@dataclass(frozen=True)
class LongOptions:
    """The options of a render in batches.

    Attributes:
        folder: The folder in which the render is saved; ``None`` if it is not saved.
        every: The interval at which it is saved.
        add: Samples per pixel to add to the samples in the folder; ``None`` for none.
        until: The relative error at which the render ends; ``None`` for no such limit.
        workers: The number of worker processes; 0 to render in this one.
        dask: The address of a Dask scheduler whose workers render; empty without Dask.
        has_preview: Whether the unfinished image is shown at this interval, even without a folder.
    """

    folder: Path | None = None
    every: Interval = Interval(seconds=60)
    add: int | None = None
    until: float | None = None
    workers: int = 0
    dask: str = ""
    has_preview: bool = False


class LongJob:
    """A render in batches, and its progress.

    Attributes:
        chosen: The scene, integrator and sensor.
        integrator, name, parameters: The integrator, its name and its parameters.
        scene, sensor: The scene and the sensor that it renders.
        film: The film that holds the image.
        is_interrupted: Whether a signal or a failure ended the render before it reached its goal.
        failure: The error that ended the render after its first batch, or that kept its last state
            from being saved; ``None`` if there was none.
        seconds: Wall clock time of the render.
        viewer: Is shown the image while it is rendered; ``None`` for nobody.
    """

    def __init__(
        self, request: RenderRequest, options: LongOptions, scenes: LastScene | None = None
    ) -> None:
        """
        Args:
            request, options: The image to render, and the options of the batches.
            scenes: Keeps the loaded scene for the next image.

        Raises:
            InputError: The scene, the integrator or the sensor cannot be used.
        """
        self._options = options
        self._folder = CheckpointFolder(options.folder) if options.folder else None
        threads = threads_of_each(options.workers) if options.workers else 0
        self._request = replace(request, threads=request.threads or threads)
        self._renderer = BatchRenderer(self._request, scenes=scenes)
        self.chosen = self._renderer.chosen
        named = self.chosen.named
        self.integrator, self.name, self.parameters = (
            named.integrator, named.name, named.parameters
        )  # fmt: skip
        self.scene, self.sensor = self.chosen.scene, self._renderer.sensor
        self.film = self.sensor.film()
        self.is_interrupted, self.seconds = False, 0.0
        self.failure: InputError | None = None
        self._state, self._render = RenderState(), None
        self.viewer: Viewer | None = None

    def run(
        self, spp: int | None, seconds: float | None, write: Callable[[bool], None], report: Report
    ) -> None:
        """Renders, starting from the samples in the folder.

        Args:
            spp: Samples per pixel of the whole image. By default, the sampler's number if nothing
                else ends the render.
            seconds: Time limit of this call.
            write: Writes the image of the film. Its argument is true if a signal requested it.
            report: Shows the progress.

        Raises:
            InputError: The folder holds another render, or the integrator cannot render the scene.
        """
        begin = time.perf_counter()
        with self._folder.in_use() if self._folder else contextlib.nullcontext():
            try:
                if self._folder:
                    self._folder.describe(self._renderer.description())
                    self._state = self._folder.load(self.film)
                    if damaged := self._folder.damaged:
                        report.warn(f"{damaged}: is damaged: continuing from the previous state")
                self._run(spp, seconds, write, report)
            finally:
                self.seconds = time.perf_counter() - begin

    def _run(self, spp, seconds, write, report) -> None:
        options, state = self._options, self._state
        if options.add:
            spp = state.spp + options.add
        elif spp is None and options.until is None and seconds is None:
            try:
                spp = sample_count(self._renderer.sensor, 0)
            except ValueError as error:
                raise InputError(f"{self.chosen.loaded.source}: {error}") from None
        if state.done:
            self._say_what_is_kept(spp, report)
        last = LastKept(state.spp)
        is_due_at_once = options.has_preview

        def keep(is_asked: bool) -> None:
            nonlocal is_due_at_once
            is_due_at_once = False
            last.mark(state.spp)
            if self._folder:
                self._folder.save(state)
            state.fill(self.film)
            self.seconds = time.perf_counter() - last.begin
            write(is_asked)

        with report.bars() as bars, _asked_to_keep() as asked:
            show = LongProgress(report, bars, self.name, math.prod(self.film.crop_size()))

            def progress(render: LongRender) -> None:
                if self.viewer and self.viewer.is_due():
                    self.show(self.viewer)
                show(render)
                is_asked, is_due = asked(), is_due_at_once
                if self._folder or options.has_preview:
                    is_due |= last.is_due(options.every, state.spp)
                if is_asked or is_due:
                    try:
                        keep(is_asked)
                    except OSError as problem:
                        report.warn(f"the render could not be saved: {problem}; it continues")

            self._render = LongRender(self._renderer, state, progress)
            goal = Goal(spp, options.until, seconds)
            is_reached, workers = False, renderers(options.workers, options.dask or None)
            try:
                with deferred_interrupt() as interrupt, workers as found:

                    def is_stopped() -> bool:
                        found.check()
                        return interrupt.is_set()

                    is_reached = self._render.run(
                        goal, is_stopped, found.executor, found.count
                    )
                if not state.done:  # stopped before any worker finished a batch
                    raise KeyboardInterrupt
            except InputError as error:  # the scheduler or too many workers were lost
                if not state.done:
                    raise
                self.failure = error
            except KeyboardInterrupt:
                if not state.done:
                    raise
            self.is_interrupted = not is_reached
        if state.done:
            state.fill(self.film)
        if self._folder:
            try:
                self._folder.save(state)
            except OSError as problem:
                # Continue: the disk may have room for the image, which is smaller
                problem = InputError(f"the render could not be saved: {problem}")
                self.failure = self.failure or problem

    def _say_what_is_kept(self, spp: int | None, report: Report) -> None:
        """Says that the render is continued, or that it already has ``spp`` samples."""
        folder, kept = self._options.folder, self._state.spp
        if spp is None or kept < spp:
            report.note(f"{folder}: continued from {kept} samples per pixel")
        elif kept == spp:
            report.note(f"{folder}: already holds all {kept} samples per pixel")
        else:
            report.warn(
                f"{folder}: already holds {kept} samples per pixel, and the image shows all of "
                f"them, not {spp}"
            )

    def show(self, viewer: Viewer) -> None:
        """Shows the image to a viewer."""
        error = self._render.error if self._render else None
        viewer.present(lambda: of_state(self._state, error))

    # ---- The state of the render ----

    @property
    def spp(self) -> int:
        """The number of samples per pixel in the image."""
        return self._state.spp

    def how_far(self) -> str:
        goal = self._render.goal_spp if self._render else 0
        return f"after {self.spp} of {goal} spp" if goal else f"after {self.spp} spp"

    def has_image(self) -> bool:
        """Whether the image has samples."""
        return bool(self._state.done)

    def is_complete(self) -> bool:
        return not self.is_interrupted

    def variance(self) -> dict[str, Any]:
        """The channels with the variance of the image, by name."""
        batches = self._state.images
        if batches is None or batches.count < 2:
            return {}
        colours = [name for name in batches.channels[: batches.image_channel_count] if name != "A"]
        variance = batches.variance
        return {f"variance.{name}": variance[..., n] for n, name in enumerate(colours)}

    @property
    def coverage(self) -> Coverage | None:
        """What covers each pixel, if the integrator has masks."""
        return self._state.coverage

    def about(self) -> Mapping[str, Any]:
        """Further metadata of the image."""
        return {"batches": len(self._state.done), "seeds": self.seeds}

    @property
    def seeds(self) -> list[int]:
        """The seeds of the samples in the image."""
        return sorted({batch.seed for batch in self._state.done})

    @property
    def totals(self) -> RenderTotals:
        """The cost of the samples in the image, over all processes that rendered them."""
        return self._state.totals


@contextlib.contextmanager
def _asked_to_keep() -> Iterator[Callable[[], bool]]:
    """While active, SIGUSR1 requests saving the render after the running batch and continuing.
    Yields a function that returns whether the signal was received since the last call."""
    asked: list[int] = []

    def take() -> bool:
        was, asked[:] = bool(asked), []
        return was

    with interrupts.requests_to_keep(lambda *_: asked.append(1)):
        yield take
