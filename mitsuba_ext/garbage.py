"""When Python's garbage collector must wait."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def garbage_left_alone() -> Iterator[None]:
    """Stops Python's garbage collector.

    To trace a call of a BSDF's method, Dr.Jit goes through all living BSDFs, and while it runs the
    methods of those that are written in Python, the collector may free others, of scenes that
    nobody uses any more: the process would end.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
