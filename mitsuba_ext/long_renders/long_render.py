"""A render in batches that ends when it reaches a goal."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass

from ..images import image_files
from ..rendering.pace import Pace
from ..util.errors import InputError
from .announced_error import announced_error
from .dispatch import QUEUE, Dispatch
from .integrator_batches import IntegratorBatches
from .state import Batch, BatchResult, RenderState

#: The minimum number of batches from which the error of an image is estimated.
_MIN_BATCHES = 8

#: A number of samples per pixel larger than in any batch.
_LARGER_THAN_A_BATCH = 1 << 30

#: The factor by which batches that measure the speed are shorter.
_PROBE_DIVISOR = 16

#: The factor by which the number of batches must grow before the error is computed again: for large
#: images, the computation takes as long as some of their samples.
_ERROR_GROWTH = 1.05


@dataclass(frozen=True)
class Goal:
    """The goal of a render, which ends as soon as one of these limits is reached.

    Attributes:
        spp: Samples per pixel; ``None`` for no limit.
        error: The relMSE of the image, estimated from its batches; ``None`` for no limit.
        seconds: The time of this call, in seconds; ``None`` for no limit. The speed of the first
            batches determines how many fit: a render that ended by the clock would be biased
            towards fast samples. In this process, they are short and learn nothing for others.
    """

    spp: int | None = None
    error: float | None = None
    seconds: float | None = None


class LongRender:
    """Adds batches to a state until a goal is reached. Batches are independent renders that any
    process can render; they are added in the order of their arrival.

    Parameters:
        renderer: The renderer of the batches.
        state: The batches rendered so far.
        progress: A function that is called after each batch.

    Attributes:
        state: All finished batches.
        goal_spp: Samples per pixel of the finished render; 0 if unknown.
    """

    def __init__(
        self,
        renderer: IntegratorBatches,
        state: RenderState,
        progress: Callable[[LongRender], None] = lambda render: None,
    ) -> None:
        self._renderer, self._progress = renderer, progress
        self.state, self.goal_spp = state, 0
        self._probes = self._teaches_late = False
        # The number of batches when the error was last computed, and that error
        self._error: tuple[int, float | None] = (0, None)

    def run(
        self,
        goal: Goal,
        is_stopped: Callable[[], bool] = lambda: False,
        executor: Executor | None = None,
        workers: int | Callable[[], int] = 1,
    ) -> bool:
        """Renders batches. Returns True if the goal was reached.

        Args:
            goal: The goal.
            is_stopped: A function that is called after each batch and while workers render, and
                returns True to end.
            executor: The executor that renders the batches of a ``BatchRenderer`` in other
                processes; see :class:`~mitsuba_ext.long_renders.dispatch.Dispatch`. ``None`` for
                this process.
            workers: The number of batches that the executor renders at a time, or a function that
                returns it.

        Raises:
            InputError: A batch cannot be rendered.
        """
        self._goal, self.goal_spp = goal, goal.spp or 0
        is_timed_here = goal.seconds is not None and executor is None
        self._probes, self._teaches_late = is_timed_here, is_timed_here
        count_workers = workers if callable(workers) else lambda: workers
        if executor is None:
            results = self._here()
        else:
            dispatch = Dispatch(executor, self._renderer, count_workers)
            results = dispatch.results(self._batches(), lambda: self._learned, is_stopped)
        # The speed is measured from the first result to the result with this number
        measured = 1 + QUEUE * count_workers()
        # Batches that use the learned state have a different speed
        plans = (measured, measured + 2) if self._teaches_late else (measured,)
        end, warm, count = time.perf_counter() + (goal.seconds or 0.0), 0.0, 0
        while not self._is_reached():
            if is_stopped() or (result := next(results, None)) is None:
                return False
            self._renderer.check(result)
            self.state.add(result)
            count += 1
            if count in (1, measured + 1):
                # Its time is not measured because it may have compiled kernels or learned
                warm, before = time.perf_counter(), self.state.spp
            elif goal.seconds is not None and count in plans:
                pace = Pace()
                pace.measure(self.state.spp - before, time.perf_counter() - warm)
                fits = self.state.spp + round(pace.fits(end - time.perf_counter()))
                self.goal_spp = min(fits, goal.spp or fits)
                self._probes = False
            self._progress(self)
        return True

    @property
    def error(self) -> float | None:
        """The relMSE estimated from the batches (possibly a few batches ago); ``None`` before there
        are enough batches, and for a black image."""
        batches = self.state.images
        if batches is None or batches.count < _MIN_BATCHES:
            return None
        if batches.count >= _ERROR_GROWTH * self._error[0]:
            both = (batches.mean, batches.variance)
            rgb = [image_files.to_rgb(each, batches.channels) for each in both]
            self._error = batches.count, announced_error(*rgb)
        return self._error[1]

    @property
    def spp_left(self) -> int | None:
        """The samples per pixel still to be rendered; ``None`` if unknown. For an error to
        reach, the estimate assumes that relMSE falls with 1/n."""
        found = [self.goal_spp - self.state.spp] if self.goal_spp else []
        if self._goal.error and (error := self.error) is not None:
            found.append(round(self.state.spp * (error / self._goal.error - 1)))
        return max(0, min(found)) if found else None

    # ---- Helpers ----

    def _is_reached(self) -> bool:
        if self.goal_spp and self.state.spp >= self.goal_spp:
            return True
        if (limit := self._goal.error) is None:
            return False
        error, is_endless = self.error, self._goal.spp is None and self._goal.seconds is None
        if error is None and is_endless and len(self.state.done) >= _MIN_BATCHES:
            raise InputError(
                f"the image is black, or not finite, after {self.state.spp} samples per pixel, and "
                f"has no relative error that could be reached: also limit the samples or the time"
            )
        return error is not None and error <= limit

    @property
    def _learned(self) -> bytes | None:
        """The learned state that the next batch loads; ``None`` if the batch has to learn it."""
        if not self._renderer.learns or (self.state.learned is None and self._is_short):
            return b""
        return self.state.learned

    @property
    def _is_short(self) -> bool:
        """Whether this call's time is, or may be, too short for a batch that learns for others."""
        longest = self._renderer.length(_LARGER_THAN_A_BATCH, teaches=True)
        left = self.goal_spp - self.state.spp
        return self._probes or (self._teaches_late and left < 2 * longest)

    def _batches(self) -> Iterator[Batch]:
        """The next batches: indices missing among the finished batches come first."""
        seed, spp = self._renderer.seed, self.state.spp
        known = {batch.index for batch in self.state.done if batch.seed == seed}
        for index in itertools.count():
            if self.goal_spp and spp >= self.goal_spp:
                return
            if index not in known:
                left = self.goal_spp - spp if self.goal_spp else _LARGER_THAN_A_BATCH
                length = self._renderer.length(left, teaches=self._learned is None)
                if self._probes:
                    length = max(1, length // _PROBE_DIVISOR)
                yield Batch(seed, index, length)
                spp += length

    def _here(self) -> Iterator[BatchResult]:
        for batch in self._batches():
            yield self._renderer.render(batch, self._learned)
