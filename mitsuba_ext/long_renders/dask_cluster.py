"""The workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Executor

from ..errors import InputError, InstallationError

#: Seconds for the scheduler to answer, and for a first worker to come.
_PATIENCE = 10


@contextlib.contextmanager
def dask_cluster(address: str) -> Iterator[tuple[Executor, int, Callable[[], None]]]:
    """A context with an executor that renders on a cluster, its number of workers (processes), and
    a function to call now and then: without the scheduler, what is awaited never comes. At the end
    of the context, batches that have not begun are cancelled.

    Args:
        address: Of the scheduler: ``tcp://host:port``.

    Raises:
        InputError: No scheduler answers, or it has no workers; or the function finds it gone.
        InstallationError: Dask is not installed.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InstallationError(
            "--dask needs the package distributed: pip install 'mitsuba_ext[dask]'"
        ) from error
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no Dask scheduler answers ({error})") from error

    def check() -> None:
        if client.status != "running":
            raise InputError(f"{address}: the Dask scheduler is gone")

    for name in ("distributed.client", "distributed.utils"):  # tracebacks of lost connections
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError:
            raise InputError(f"{address}: the Dask scheduler has no workers") from None
        # By default, a batch that has failed would not be tried again: Dask takes it for known
        executor = client.get_executor(pure=False)
        try:
            yield executor, len(client.scheduler_info(n_workers=-1)["workers"]), check
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)
