"""What ends a render: Ctrl-C, and the signals by which batch systems and closed terminals ask."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator

from ..rendering import interrupts
from .common import INTERRUPTED, say


class Stop(interrupts.InterruptHandler):
    """The handler of the signals, and what has asked for the end so far. Only the first signal
    does something here; what comes later is the business of :func:`_watching`, which knows when a
    signal came. (Handlers in Python learn of it after the native code that is running.)"""

    is_writing = False

    def __call__(self, number: int, frame: object) -> None:
        if self.number is None and not self.is_writing:
            super().__call__(number, frame)

    @property
    def is_asked(self) -> bool:
        """Was there a signal?"""
        return self.number is not None

    @property
    def exit_code(self) -> int:
        """That of a process which the signal ended."""
        return INTERRUPTED if self.number is None else 128 + self.number

    def wait(self) -> None:
        """From now on, signals do nothing: the image is being written."""
        self.is_writing = True


@contextlib.contextmanager
def stopping() -> Iterator[Stop]:
    """While active, the first signal raises ``KeyboardInterrupt`` (where passes are rendered, after
    the running one); a second signal ends the process at once, whatever code is running, but not
    after :meth:`Stop.wait`. Signals that come together count as one; those that are ignored, as
    SIGHUP is under ``nohup``, stay so."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    with interrupts.handling(interrupts.SIGNALS, stop), _watching(stop):
        yield stop


@contextlib.contextmanager
def _watching(stop: Stop) -> Iterator[None]:
    """A thread that learns of signals while native code runs, when no handler in Python does."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        first = None
        while number := receiver.recv(1):  # nothing once the sender is closed
            if number[0] not in interrupts.SIGNALS:
                continue
            now = time.monotonic()
            first = first or now
            if now - first > interrupts.TOGETHER and not stop.is_writing:
                say("interrupted again: the render is given up")
                os._exit(128 + number[0])

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        sender.close()
        thread.join()
        receiver.close()
