"""Distributes batches to workers that may die or hang."""

from __future__ import annotations

import json
import queue
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..util.errors import InputError
from .batch_renderer import BatchRenderer, RenderRequest
from .bundle import Bundle
from .state import Batch, BatchResult
from .tasks import Missing, digest_of, render_batch
from .workers import WorkerKilledError

#: The number of batches submitted at a time, per worker.
QUEUE = 2

#: The number of failures of a batch after which the render ends with an error: its own failures,
#: and kills of its process from outside. A kill says little about the batch, but the memory that it
#: needs may be the reason every time.
_MAX_FAILURES, _MAX_KILLS = 3, 10

#: The time after which a batch is late: the first number times the median time from submission to
#: result. Before the first result, it is the second number of seconds.
_LATE_FACTOR, _FIRST_RESULT_LATE = 5.0, 600.0

#: The number of recent results whose times give the median.
_MEDIAN_COUNT = 101


@dataclass
class _Task:
    """A batch submitted to workers.

    Attributes:
        given: The time of the last submission.
        copies: The number of further submissions because its result was late.
        failures: The number of failures.
        futures: The futures of all unfinished submissions.
        needs: The data that workers lacked, which the next submission includes.
    """

    given: float
    copies: int = 0
    failures: int = 0
    futures: tuple[Future, ...] = ()
    needs: Missing = Missing(False, False)


class Dispatch:
    """Renders batches with an executor. A batch that fails, or whose result is late, is submitted
    again; its first result is used.

    An executor may have two additional methods. ``share(value)`` returns a handle that can be sent
    to many workers in place of the value. ``avoid(future)`` gives no other tasks to the worker of
    ``future`` until the future is done.

    Parameters:
        executor: The executor that runs the workers, which need this package, but not the scene's
            files.
        renderer: The renderer whose batches they render.
        workers: A function that returns the number of batches that the executor renders at a time.

    Attributes:
        period: The time between two checks of the submitted batches, in seconds.
        min_late: The minimum time after which a batch is late, in seconds: a new worker loads the
            scene and compiles kernels.
    """

    period = 1.0
    min_late = 60.0

    def __init__(
        self,
        executor: Executor,
        renderer: BatchRenderer,
        workers: Callable[[], int],
    ) -> None:
        self._executor, self._renderer, self._workers = executor, renderer, workers
        # Workers have a different current folder, and their files may differ
        description = json.dumps(renderer.description(), default=str)
        self._request = replace(_absolute(renderer.request), description=description)
        self._tasks: dict[Batch, _Task] = {}
        self._running: dict[Future, Batch] = {}
        # A queue, because ``concurrent.futures.wait`` takes milliseconds for thousands of futures
        self._finished: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._looked = 0.0
        self._seconds: deque[float] = deque(maxlen=_MEDIAN_COUNT)
        self._shared: dict[str, Any] = {}
        self._bundle: Bundle | None = None

    def results(
        self,
        batches: Iterator[Batch],
        learned: Callable[[], bytes | None],
        is_stopped: Callable[[], bool],
    ) -> Iterator[BatchResult]:
        """Yields the results of the batches in the order of their arrival.

        Args:
            batches: The batches to render.
            learned: A function that returns the learned state that batches load; ``None`` until the
                first batch, which is rendered alone, has learned it.
            is_stopped: A function that is called while no result arrives, and returns True to end.

        Raises:
            InputError: A batch cannot be rendered.
        """
        try:
            while True:
                most = 1 if learned() is None else QUEUE * max(1, self._workers())
                while len(self._tasks) < most and (batch := next(batches, None)):
                    self._tasks[batch] = _Task(time.monotonic())
                    self._give(batch, learned())
                if not self._tasks:
                    return
                try:
                    future = self._finished.get(timeout=self.period)
                except queue.Empty:
                    if is_stopped():
                        return
                else:
                    result = self._taken(future, learned(), is_stopped)
                    if result is not None:
                        yield result
                if self._finished.empty():
                    self._give_late_ones(learned())
        finally:
            for future in self._running:
                future.cancel()

    def _give(self, batch: Batch, learned: bytes | None) -> None:
        """Submits a batch, with the data that its workers lacked."""
        task = self._tasks[batch]
        sent, bundle = None, None
        if task.needs.learned:
            sent = self._share("learned", lambda: learned)
        if task.needs.scene:
            bundle = self._share("scene", self._make_bundle)
        future = self._executor.submit(
            render_batch, self._request, batch, digest_of(learned), sent, bundle
        )
        self._running[future] = batch
        task.futures += (future,)
        future.add_done_callback(self._finished.put)

    def _taken(
        self, future: Future, learned: bytes | None, is_stopped: Callable[[], bool]
    ) -> BatchResult | None:
        """The result of a batch; ``None`` if there is none yet or another copy was faster."""
        batch = self._running.pop(future)
        task = self._tasks.get(batch)
        if task is None:  # a copy was faster
            return None
        task.futures = tuple(other for other in task.futures if other is not future)
        failure = _failure(future)
        if failure is None:
            result = future.result()
            if isinstance(result, Missing):
                task.needs = Missing(*map(max, task.needs, result))
                self._give(batch, learned)
                return None
            self._seconds.append(time.monotonic() - task.given)
            del self._tasks[batch]
            for other in task.futures:
                other.cancel()
            return result
        self._shared.clear()  # the shared values may have been lost with a worker
        task.failures += 1
        if is_stopped():  # the workers may have received the same signal
            return None
        was_killed = isinstance(failure, WorkerKilledError)
        if task.failures >= (_MAX_KILLS if was_killed else _MAX_FAILURES):
            raise InputError(f"a batch failed {task.failures} times: {failure}") from failure
        if not task.futures:
            task.given = time.monotonic()
            self._give(batch, learned)
        return None

    def _give_late_ones(self, learned: bytes | None) -> None:
        now = time.monotonic()
        if now - self._looked < self.period:
            return
        self._looked = now
        limit = _FIRST_RESULT_LATE
        if self._seconds:
            limit = max(self.min_late, _LATE_FACTOR * statistics.median(self._seconds))
        for batch, task in self._tasks.items():
            # The limit doubles with each copy, because the batch may be slow rather than its worker
            if now - task.given > limit * 2**task.copies:
                for future in task.futures:
                    getattr(self._executor, "avoid", lambda future: None)(future)
                task.given, task.copies = now, task.copies + 1
                self._give(batch, learned)

    def _share(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._shared:
            share = getattr(self._executor, "share", lambda value: value)
            self._shared[name] = share(make())
        return self._shared[name]

    def _make_bundle(self) -> Bundle:
        if self._bundle is None:
            specification = self._request.specification
            is_file = specification and Path(specification).is_file()
            others = (specification,) if is_file else ()
            self._bundle = Bundle.of(self._renderer.chosen.loaded, others)
        return self._bundle


def _absolute(request: RenderRequest) -> RenderRequest:
    """The request with absolute file paths, which are valid in any current folder."""

    def absolute(name: str) -> str:
        path = Path(name)
        return str(path.absolute()) if path.suffix and path.is_file() else name

    return replace(
        request, scene=absolute(request.scene), plugins=tuple(map(absolute, request.plugins)),
        specification=request.specification and absolute(request.specification),
    )  # fmt: skip


def _failure(future: Future) -> BaseException | None:
    """The error of a batch; ``None`` if it succeeded. Raises the error if it concerns the input."""
    if future.cancelled():
        return CancelledError("its worker is gone")
    error = future.exception()
    if isinstance(error, InputError):
        raise error
    return error
