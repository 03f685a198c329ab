"""Processes on this machine that render batches."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.process import BaseProcess
from typing import Any

from ..rendering import interrupts

_PR_SET_PDEATHSIG = 1

#: The exit codes of processes killed by a user or by the system.
_KILL_CODES = [
    -getattr(signal, name) for name in ("SIGKILL", "SIGTERM") if hasattr(signal, name)
]

#: The maximum time to wait for the exit code of a dead process, in seconds.
_TIMEOUT = 5


def threads_of_each(count: int) -> int:
    """The number of threads of each of ``count`` processes that share this machine."""
    # With one thread, Mitsuba 3.9.1 deadlocks when it reads an EXR file
    return max(2, (os.cpu_count() or 1) // count)


class WorkerKilledError(RuntimeError):
    """The process of a task was ended by a signal from a user, from a batch system, or from the
    operating system when memory ran out. (Faults in native code send other signals.)"""


class Workers(Executor):
    """Processes, each of which runs one task at a time. A process that dies is replaced, and only
    its own task fails. (In a single ``ProcessPoolExecutor``, all tasks would fail.)

    Parameters:
        count: The number of processes.
    """

    def __init__(self, count: int) -> None:
        self._waiting: queue.SimpleQueue = queue.SimpleQueue()
        self._pools: list[ProcessPoolExecutor | None] = [None] * count
        self._processes: list[BaseProcess | None] = [None] * count
        self._is_given_up = False
        # A process ends with the thread that started it, so these threads must live as long as this
        # object
        self._threads = [
            threading.Thread(target=self._serve, args=(number,), daemon=True)
            for number in range(count)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, function: Callable, /, *arguments: Any, **options: Any) -> Future:
        future: Future = Future()
        self._waiting.put((future, function, arguments, options))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the processes. With ``cancel_futures``, they are killed, because their tasks are no
        longer needed and may hang."""
        if cancel_futures:
            self._is_given_up = True
            for pool in filter(None, self._pools):
                for process in list((pool._processes or {}).values()):
                    process.kill()
        for _ in self._threads:
            self._waiting.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def _serve(self, number: int) -> None:
        """Runs the waiting tasks in a process, one after the other."""
        while (item := self._waiting.get()) is not None:
            future, function, arguments, options = item
            if self._is_given_up:
                future.cancel()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = self._submitted(number, function, arguments, options).result()
            except BrokenProcessPool as error:
                future.set_exception(self._killed(number) or error)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(result)
        if pool := self._pools[number]:
            pool.shutdown()

    def _killed(self, number: int) -> WorkerKilledError | None:
        """Says how a process was killed; ``None`` if it was not."""
        exit_code = _exit_code(self._processes[number])
        if exit_code not in _KILL_CODES:
            return None
        name = signal.Signals(-exit_code).name
        return WorkerKilledError(
            f"its process was killed ({name}), by a user or because memory ran out"
        )

    def _submitted(self, number: int, function, arguments, options) -> Future:
        if pool := self._pools[number]:
            try:
                return pool.submit(function, *arguments, **options)
            except BrokenProcessPool:
                pool.shutdown(wait=False)
        # A forked process would share the threads and kernels of this process
        context = multiprocessing.get_context("spawn")
        self._pools[number] = pool = ProcessPoolExecutor(1, context, _start, (os.getpid(),))
        future = pool.submit(function, *arguments, **options)
        (self._processes[number],) = pool._processes.values()
        return future


def _exit_code(process: BaseProcess) -> int | None:
    """The exit code of a process whose pool is broken; ``None`` if it is still unknown after some
    seconds."""
    end = time.monotonic() + _TIMEOUT
    process.join(_TIMEOUT)
    # The pool waits for the process too. If the pool's thread is told of the end and has not stored
    # the exit code yet, the process has already ended and has no exit code
    while (code := process.exitcode) is None and time.monotonic() < end:
        time.sleep(0.01)
    return code


def _start(parent: int) -> None:
    """Makes a worker process ignore signals, which its parent handles, and end with its parent."""
    # Batch systems send signals to all processes. SIGTERM is not ignored: the pool sends it
    for number in {*interrupts.SIGNALS, interrupts.KEEP} - {signal.SIGTERM, None}:
        signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # the parent has already ended
            os._exit(1)
