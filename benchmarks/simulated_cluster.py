"""The scheduler of long renders with a thousand simulated workers.

    python benchmarks/simulated_cluster.py

gives batches to simulated workers in simulated time. The scheduler is the real one. Workers differ
in speed, some die in the middle of a batch (and are replaced), and some hang for ever. It prints
when the render ends, in units of the time that workers without faults need, and what the scheduler
costs in real time for each batch. It adds no images: ``--merge`` seconds stand for that.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import queue
import random
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from types import SimpleNamespace

import mitsuba_ext  # noqa: F401
from mitsuba_ext.long_renders import dispatch
from mitsuba_ext.long_renders.batch_renderer import RenderRequest
from mitsuba_ext.long_renders.state import Batch, BatchResult


class Cluster(Executor):
    """Workers, and a clock that only they and the scheduler's waiting move.

    Parameters:
        count: Of workers.
        seconds: Of a batch, on a worker of the usual speed.
        spread: Standard deviation of the logarithm of a batch's time.
        deaths, hangs: Probabilities that a worker dies, or hangs, in a batch.
    """

    def __init__(
        self, count: int, seconds: float, spread: float, deaths: float, hangs: float, seed: int
    ) -> None:
        self.now, self.deaths, self.hangs, self.copies = 0.0, 0, 0, 0
        self._rates = seconds, spread, deaths, hangs
        self._rng, self._numbers = random.Random(seed), itertools.count()
        self._idle, self._waiting, self._events = count, deque(), []
        self._finished: deque[Future] = deque()

    # ---- An executor ----

    def submit(self, function, *arguments) -> Future:
        future = Future()
        self._waiting.append((future, arguments[1]))
        self._begin()
        return future

    def avoid(self, future: Future) -> None:
        self.copies += 1

    def _begin(self) -> None:
        seconds, spread, deaths, hangs = self._rates
        while self._idle and self._waiting:
            future, batch = self._waiting.popleft()
            if future.cancelled():
                continue
            self._idle -= 1
            duration = seconds * self._rng.lognormvariate(0.0, spread)
            fate = self._rng.random()
            if fate < hangs:
                self.hangs += 1
                continue
            is_dead = fate < hangs + deaths
            if is_dead:  # somewhere in the middle; another worker comes after a minute
                self.deaths += 1
                duration *= self._rng.random()
            end = self.now + duration
            heapq.heappush(self._events, (end, next(self._numbers), future, batch, is_dead))

    def _happens(self) -> None:
        self.now, _, future, batch, is_dead = heapq.heappop(self._events)
        if future is None:  # a new worker
            self._idle += 1
        elif is_dead:
            back = self.now + 60
            heapq.heappush(self._events, (back, next(self._numbers), None, None, False))
            if not future.cancelled():
                future.set_exception(OSError("the worker has died"))
        else:
            self._idle += 1
            if not future.cancelled():
                future.set_result(BatchResult(batch, None, True, None, (), 0, (), None))
        self._begin()

    # ---- The queue and the clock of the scheduler ----

    def put(self, future: Future) -> None:
        self._finished.append(future)

    def empty(self) -> bool:
        return not self._finished

    def get(self, timeout: float) -> Future:
        end = self.now + timeout
        while not self._finished:
            if not self._events or self._events[0][0] > end:
                self.now = end
                raise queue.Empty
            self._happens()
        return self._finished.popleft()

    def monotonic(self) -> float:
        return self.now


def simulated(
    batch_count: int, workers: int, merge: float, cluster: Cluster
) -> tuple[float, float, int]:
    """Simulated seconds of a render, real seconds of the scheduler, and batches that count."""
    renderer = SimpleNamespace(request=RenderRequest("scene.xml"), description=lambda: {})
    scheduler = dispatch.Dispatch(cluster, renderer, lambda: workers)
    scheduler._finished = cluster
    dispatch.time = cluster

    def batches() -> Iterator[Batch]:
        for index in range(batch_count):
            yield Batch(0, index, 16)

    begin, found = time.process_time(), set()
    for result in scheduler.results(batches(), lambda: b"", lambda: False):
        assert result.batch not in found
        found.add(result.batch)
        busy = cluster.now + merge
        while cluster._events and cluster._events[0][0] <= busy:
            cluster._happens()
        cluster.now = busy
    return cluster.now, time.process_time() - begin, len(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=1000)
    parser.add_argument("--batches", type=int, default=100, help="for each worker")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a batch")
    parser.add_argument("--merge", type=float, default=0.001, help="seconds to add a result")
    arguments = parser.parse_args()
    count = arguments.batches * arguments.workers
    ideal = arguments.batches * arguments.seconds
    print(f"{arguments.workers} workers, {count} batches of {arguments.seconds:g} s")
    for name, spread, deaths, hangs in (
        ("all alike", 0.0, 0.0, 0.0),
        ("stragglers", 0.5, 0.0, 0.0),
        ("1 in 1000 dies", 0.0, 0.001, 0.0),
        ("1 in 10000 hangs", 0.0, 0.0, 0.0001),
        ("all of it", 0.5, 0.001, 0.0001),
    ):
        cluster = Cluster(arguments.workers, arguments.seconds, spread, deaths, hangs, 1)
        seconds, cost, done = simulated(count, arguments.workers, arguments.merge, cluster)
        mean = 2.718281828 ** (spread**2 / 2)
        assert done == count
        print(
            f"{name:18} ends after {seconds / (ideal * mean):.3f} of the ideal time; "
            f"{cluster.deaths} died, {cluster.hangs} hung, {cluster.copies} copies; "
            f"{cost / count * 1e3:.3f} ms of the scheduler and the simulation for each batch",
            flush=True,
        )


if __name__ == "__main__":
    main()
