"""Stops Python's garbage collector while Dr.Jit traces calls of BSDFs."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Iterator


class _Collector:
    """The garbage collector, which all threads share.

    Attributes:
        lock: Held while the collector is being stopped or started.
        stops: The number of contexts that currently keep it stopped.
        was_enabled: Whether it was enabled before the first of these contexts.
    """

    def __init__(self) -> None:
        self.lock, self.stops, self.was_enabled = threading.Lock(), 0, False


_collector = _Collector()


@contextlib.contextmanager
def garbage_left_alone() -> Iterator[None]:
    """Stops Python's garbage collector while active, in any thread.

    To trace a call of a BSDF's method, Dr.Jit iterates over all living BSDFs. While it runs the
    methods of BSDFs written in Python, the collector could free BSDFs of scenes that are no longer
    used. Dr.Jit would then access freed memory and crash.
    """
    with _collector.lock:
        if _collector.stops == 0:
            _collector.was_enabled = gc.isenabled()
            gc.disable()
        _collector.stops += 1
    try:
        yield
    finally:
        with _collector.lock:
            _collector.stops -= 1
            if _collector.stops == 0 and _collector.was_enabled:
                gc.enable()
