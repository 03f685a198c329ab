"""Processes of this machine that render batches."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from ..rendering import interrupts

_PR_SET_PDEATHSIG = 1


class Workers(Executor):
    """A pool of processes that replaces those that die: what these were doing fails.

    Parameters:
        count: How many processes there are.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool = self._new_pool()

    def submit(self, function: Callable, /, *arguments: Any, **options: Any) -> Future:
        try:
            return self._pool.submit(function, *arguments, **options)
        except BrokenProcessPool:
            self._pool.shutdown(wait=False)
            self._pool = self._new_pool()
            return self._pool.submit(function, *arguments, **options)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def _new_pool(self) -> ProcessPoolExecutor:
        # A forked process would share the threads and kernels of this one
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self._count, context, _start, (os.getpid(),))


def _start(parent: int) -> None:
    """Leaves signals to the parent, and ends with it."""
    for number in interrupts.SIGNALS:
        if number != signal.SIGTERM:  # by which the pool ends its processes
            signal.signal(number, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended meanwhile
            os._exit(1)
