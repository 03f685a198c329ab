"""A render of as many batches as it takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from dataclasses import dataclass

from ..compare import images, metrics
from ..errors import InputError
from .batch_renderer import BatchRenderer, RenderRequest, render_batch
from .state import Batch, BatchResult, RenderState

#: Batches, at least, that tell the error of an image.
_FEWEST = 8

#: Batches that wait at each worker.
_QUEUE = 2

#: Seconds between two looks at what others render.
_PERIOD = 1.0

#: How often a batch is tried before the render is given up.
_TRIES = 3


@dataclass(frozen=True)
class Goal:
    """When a render ends: at the first of these.

    Attributes:
        spp: Samples per pixel; ``None`` for no limit.
        error: The relative error of the image, as relMSE, that its batches announce.
        seconds: The time of this call. The first batches tell how many fit: a render that ended by
            the clock would prefer samples that are fast.
    """

    spp: int | None = None
    error: float | None = None
    seconds: float | None = None


class LongRender:
    """Adds batches to a state until a goal is reached. Batches are independent renders, and are
    added in their order: it does not matter who renders them.

    Parameters:
        renderer, request: What to render.
        state: What has been rendered already.
        progress: Called after each batch.

    Attributes:
        state: What has been rendered.
        goal_spp: Samples per pixel in the end, as far as it is known.
    """

    def __init__(
        self,
        renderer: BatchRenderer,
        request: RenderRequest,
        state: RenderState,
        progress: Callable[[LongRender], None] = lambda render: None,
    ) -> None:
        self._renderer, self._request, self._progress = renderer, request, progress
        self.state, self.goal_spp = state, 0

    def run(
        self,
        goal: Goal,
        is_stopped: Callable[[], bool] = lambda: False,
        executor: Executor | None = None,
        workers: int = 1,
    ) -> bool:
        """Renders; was the goal reached?

        Args:
            goal: When to end.
            is_stopped: Asked after each batch, and while batches of others are awaited.
            executor: Who renders: functions that it is given must find the same files. ``None`` for
                this process.
            workers: How many batches the executor renders at a time.
        """
        self._goal, self.goal_spp = goal, goal.spp or 0
        results = self._here()
        if executor is not None:
            results = self._elsewhere(executor, workers, is_stopped)
        begin, warm, count = time.perf_counter(), 0.0, 0
        while not self._is_reached():
            if is_stopped() or (result := next(results, None)) is None:
                return False
            self.state.add(result)
            count += 1
            if count == 1:
                # Its kernels may have been compiled
                warm, before = time.perf_counter(), self.state.spp
            elif goal.seconds is not None and count == 1 + _QUEUE * workers:
                seconds = (time.perf_counter() - warm) / (self.state.spp - before)
                self._plan(goal.seconds - (time.perf_counter() - begin), seconds)
            self._progress(self)
        return True

    @property
    def error(self) -> float | None:
        """The relative error that the batches announce, as relMSE; ``None`` before there are enough
        of them."""
        batches = self.state.images
        if batches is None or batches.count < _FEWEST:
            return None
        rgb = [images.to_rgb(x, batches.channels) for x in (batches.mean, batches.variance)]
        return metrics.reference_noise(*rgb)

    @property
    def spp_left(self) -> int | None:
        """Samples per pixel that are still to come, as far as it is known: until an error is
        reached, as many as its fall with 1/n announces."""
        found = [self.goal_spp - self.state.spp] if self.goal_spp else []
        if self._goal.error and (error := self.error) is not None:
            found.append(round(self.state.spp * (error / self._goal.error - 1)))
        return max(0, min(found)) if found else None

    # ---- Helpers ----

    def _is_reached(self) -> bool:
        if self.goal_spp and self.state.spp >= self.goal_spp:
            return True
        limit = self._goal.error
        return limit is not None and (error := self.error) is not None and error <= limit

    def _plan(self, left: float, seconds: float) -> None:
        """Says how many samples fit into the time that is left, by the seconds of one."""
        fits = self.state.spp + max(0, round(left / seconds))
        self.goal_spp = min(fits, self._goal.spp or fits)

    def _batches(self) -> Iterator[Batch]:
        """The next batches."""
        seed, spp = self._request.seed, self.state.spp
        index = 1 + max((b.index for b in self.state.done if b.seed == seed), default=-1)
        while not self.goal_spp or spp < self.goal_spp:
            left = self.goal_spp - spp if self.goal_spp else 1 << 30
            batch = Batch(seed, index, self._renderer.length(left))
            yield batch
            index, spp = index + 1, spp + batch.spp

    def _here(self) -> Iterator[BatchResult]:
        for batch in self._batches():
            yield self._renderer.render(batch)

    def _elsewhere(
        self, executor: Executor, workers: int, is_stopped: Callable[[], bool]
    ) -> Iterator[BatchResult]:
        """The same, by others, some of which may fail."""
        batches, running, done = self._batches(), {}, {}
        tries: dict[Batch, int] = {}
        order: list[Batch] = []

        def submit(batch: Batch) -> None:
            tries[batch] = tries.get(batch, 0) + 1
            running[executor.submit(render_batch, self._request, batch)] = batch

        # The first batch teaches the others
        most = 1 if self._renderer.must_learn else _QUEUE * workers
        while True:
            while len(order) < most and (batch := next(batches, None)):
                order.append(batch)
                submit(batch)
            while order and order[0] not in done:
                finished = wait(running, _PERIOD, FIRST_COMPLETED).done
                if not finished and is_stopped():
                    return
                for future in finished:
                    batch = running.pop(future)
                    if (failure := _failure(future)) is None:
                        done[batch] = future.result()
                    elif is_stopped():  # the workers may have got the same signal
                        return
                    elif tries[batch] < _TRIES:
                        submit(batch)
                    else:
                        raise InputError(f"a batch failed {_TRIES} times: {failure}") from failure
            if not order:
                return
            yield done.pop(order.pop(0))
            most = _QUEUE * workers


def _failure(future: Future) -> BaseException | None:
    """Why a batch failed; raises what is wrong with the input."""
    if future.cancelled():
        return CancelledError("its worker is gone")
    error = future.exception()
    if isinstance(error, InputError):
        raise error
    return error
