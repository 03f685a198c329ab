"""The workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
import uuid
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import TYPE_CHECKING, Any

from ..util.errors import InputError, InstallationError

if TYPE_CHECKING:
    from distributed import Client

#: The time between two queries for the list of workers, in seconds.
_PERIOD = 5.0


class DaskWorkers(Executor):
    """The executor of a Dask client, with the additional methods of
    :class:`~mitsuba_ext.long_renders.dispatch.Dispatch`.

    Parameters:
        client: The client.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        # By default (pure), Dask would not run a failed batch again, but return the stored result
        self._executor = client.get_executor(pure=False)
        self._keys: weakref.WeakKeyDictionary[Future, str] = weakref.WeakKeyDictionary()
        self._avoided: set[str] = set()
        self._known: set[str] = set()
        self._asked = -_PERIOD

    def submit(self, function: Callable, /, *arguments: Any, **options: Any) -> Future:
        key = f"batch-{uuid.uuid4().hex}"
        where = {}
        if self._avoided and (good := self._addresses() - self._avoided):
            where["workers"] = sorted(good)
        future = self._executor.submit(function, *arguments, key=key, **where, **options)
        self._keys[future] = key
        return future

    def share(self, value: Any) -> Any:
        """Stores a value on one worker, from which the others fetch it."""
        return self._client.scatter([value], hash=False)[0]

    def avoid(self, future: Future) -> None:
        """Gives no further tasks to the worker of this task until the task is done."""
        key = self._keys.get(future)
        for address, keys in self._client.processing().items():
            if key in keys:
                self._avoided.add(address)
                future.add_done_callback(functools.partial(self._forgive, address))
                return

    def _forgive(self, address: str, _future: Future) -> None:
        self._avoided.discard(address)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._executor.shutdown(wait=wait)

    def count(self) -> int:
        """The number of workers (processes)."""
        return len(self._addresses())

    def _addresses(self) -> set[str]:
        now = time.monotonic()
        if now - self._asked > _PERIOD:
            self._asked = now
            with contextlib.suppress(OSError):  # the scheduler does not answer
                self._known = set(self._client.scheduler_info(n_workers=-1)["workers"])
        return self._known


@contextlib.contextmanager
def dask_cluster(
    address: str, timeout: float = 10
) -> Iterator[tuple[DaskWorkers, Callable[[], None]]]:
    """A context with an executor that renders on a cluster, and a function that checks the
    connection. Call the function periodically: without the scheduler, results never arrive. At the
    end of the context, batches that have not started are cancelled.

    Args:
        address: The address of the scheduler: ``tcp://host:port``.
        timeout: The time limit for the scheduler to answer and for a first worker to connect, in
            seconds.

    Raises:
        InputError: No scheduler answers, or it has no workers. The function also raises it if the
            connection is lost.
        InstallationError: Dask is not installed.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InstallationError(
            "--dask needs the package distributed: pip install 'mitsuba_ext[dask]'"
        ) from error
    try:
        client = Client(address, timeout=timeout, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{address}: no Dask scheduler answers ({error})") from error

    def check() -> None:
        if client.status != "running":
            raise InputError(f"{address}: the Dask scheduler is gone")

    # Silences tracebacks of lost connections, including those in callbacks of Dask's (Tornado's)
    # event loop. Each of these loggers has a separate level
    for name in {"tornado.application", *logging.Logger.manager.loggerDict}:
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with client:
        try:
            client.wait_for_workers(1, timeout=timeout)
        except TimeoutError:
            raise InputError(f"{address}: the Dask scheduler has no workers") from None
        executor = DaskWorkers(client)
        try:
            yield executor, check
        finally:
            if client.status == "running":
                executor.shutdown(wait=False)
