"""Ends a render on Ctrl-C, and on the signals that batch systems and closed terminals send."""

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
    """Handles the first signal, and remembers it. The thread of :func:`_watching` handles later
    signals, which it receives at once. (Python calls this handler only after running native code
    returns.)"""

    is_writing = False

    def __call__(self, number: int, frame: object) -> None:
        if self.number is None and not self.is_writing:
            super().__call__(number, frame)

    @property
    def is_asked(self) -> bool:
        """Whether a signal was received."""
        return self.number is not None

    @property
    def exit_code(self) -> int:
        """The exit code of a process ended by the signal."""
        return INTERRUPTED if self.number is None else 128 + self.number

    def wait(self) -> None:
        """Makes further signals ignored, because the image is being written."""
        self.is_writing = True


@contextlib.contextmanager
def stopping() -> Iterator[Stop]:
    """While active, the first signal raises ``KeyboardInterrupt``; during passes, it does so after
    the running one. A second signal ends the process at once, whatever code is running, but not
    after :meth:`Stop.wait`. Signals within half a second count as one. Signals that were ignored
    before, such as SIGHUP under ``nohup``, stay ignored."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    with interrupts.handling(interrupts.SIGNALS, stop), _watching(stop):
        yield stop


@contextlib.contextmanager
def _watching(stop: Stop) -> Iterator[None]:
    """Runs a thread that receives signals at once, even while native code blocks handlers."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        first = None
        while number := receiver.recv(1):  # empty once the sender is closed
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
