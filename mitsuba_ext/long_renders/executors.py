"""What renders batches: this process, other processes of this machine, or a cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import NamedTuple

from .dask_cluster import dask_cluster
from .workers import Workers


class Renderers(NamedTuple):
    """What renders batches.

    Attributes:
        executor: The executor; ``None`` for this process.
        count: Returns the number of workers, which may change.
        check: Raises :class:`InputError` if the workers were lost.
    """

    executor: Executor | None
    count: Callable[[], int] = lambda: 1
    check: Callable[[], None] = lambda: None


@contextlib.contextmanager
def renderers(workers: int | None, dask: str | None) -> Iterator[Renderers]:
    """A context with the workers that the options ``--workers`` and ``--dask`` ask for.

    Args:
        workers: Number of processes of this machine; 0 or ``None`` for none.
        dask: The address of a Dask scheduler; ``None`` for none.

    Raises:
        InputError, InstallationError: See :func:`~.dask_cluster.dask_cluster`.
    """
    if dask is not None:
        with dask_cluster(dask) as (executor, check):
            yield Renderers(executor, executor.count, check)
    elif workers:
        executor = Workers(workers)
        try:
            yield Renderers(executor, lambda: workers)
        finally:
            executor.shutdown(cancel_futures=True)
    else:
        yield Renderers(None)
