"""Ctrl-C between two passes of a render."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

import mitsuba as mi


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """While active, the first Ctrl-C only sets the event, so that the running pass can finish; a
    second one interrupts at once (or as soon as Mitsuba returns to Python)."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = signal.getsignal(signal.SIGINT)

    def handler(_signum, _frame) -> None:
        event.set()
        signal.signal(signal.SIGINT, previous or signal.SIG_DFL)
        mi.Log(mi.LogLevel.Warn, "Interrupted: the running pass is being finished.")

    signal.signal(signal.SIGINT, handler)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous or signal.SIG_DFL)
