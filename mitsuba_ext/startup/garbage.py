"""Stops Python's garbage collector while Dr.Jit traces calls of BSDFs."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Iterator


class _Collector:
    """The garbage collector, which all threads share.

    Attributes:
        lock: Held while it is stopped or started.
        stops: How many contexts keep it stopped now.
        was_enabled: Was it enabled before the first of them?
    """

    def __init__(self) -> None:
        self.lock, self.stops, self.was_enabled = threading.Lock(), 0, False


_collector = _Collector()


@contextlib.contextmanager
def garbage_left_alone() -> Iterator[None]:
    """Stops Python's garbage collector while active, in any thread.

    To trace a call of a BSDF's method, Dr.Jit iterates over all living BSDFs. While it runs the
    methods of those that are written in Python, the collector could free others, of scenes that are
    no longer used. Dr.Jit would then access freed memory, and the process would end.
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
