"""Stops Python's garbage collector while Dr.Jit traces calls of BSDFs."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def garbage_left_alone() -> Iterator[None]:
    """Stops Python's garbage collector while active.

    To trace a call of a BSDF's method, Dr.Jit iterates over all living BSDFs. While it runs the
    methods of those that are written in Python, the collector could free others, of scenes that are
    no longer used. Dr.Jit would then access freed memory, and the process would end.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
