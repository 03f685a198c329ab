"""What ends a render: Ctrl-C, and the signals by which batch systems and closed terminals ask."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator

import click

from .common import INTERRUPTED

#: Signals that come together count as one: a terminal that is closed may send several.
_TOGETHER = 0.5

#: They are treated alike: the first one ends the render and keeps its image. Batch systems send
#: SIGTERM some seconds before they kill; a terminal that is closed sends SIGHUP.
_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]


class Stop:
    """What has asked for the end so far.

    Attributes:
        number: The first signal, as far as it was another one than Ctrl-C.
    """

    number: int | None = None

    @property
    def is_asked(self) -> bool:
        """Was there such a signal?"""
        return self.number is not None

    @property
    def exit_code(self) -> int:
        """That of a process which the signal ended."""
        return INTERRUPTED if self.number is None else 128 + self.number

    def wait(self) -> None:
        """From now on, a signal that comes together with the first one does nothing: the image is
        being written."""
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                signal.signal(number, lambda *_: None)

    def handle(self, number: int, frame: object) -> None:
        """Does what Ctrl-C would do now: end at once, or after the running pass."""
        self.number = self.number or number
        handler = signal.getsignal(signal.SIGINT)
        if callable(handler):
            handler(signal.SIGINT, frame)
        else:  # what a shell runs in the background ignores Ctrl-C
            raise KeyboardInterrupt


@contextlib.contextmanager
def stopping() -> Iterator[Stop]:
    """While active, each of the signals raises ``KeyboardInterrupt``, as Ctrl-C does (where passes
    are rendered, after the running one); a second signal ends the process at once, whatever code is
    running. Signals that are ignored, as SIGHUP is under ``nohup``, stay so."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    previous = {number: signal.getsignal(number) for number in _SIGNALS}
    for number, handler in previous.items():
        if number != signal.SIGINT and handler is not signal.SIG_IGN:
            signal.signal(number, stop.handle)
    try:
        with _watching():
            yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)


@contextlib.contextmanager
def _watching() -> Iterator[None]:
    """A thread that learns of signals while native code runs, when no handler in Python does."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def watch() -> None:
        first = None
        while number := receiver.recv(1):  # nothing once the sender is closed
            if number[0] not in _SIGNALS:
                continue
            now = time.monotonic()
            first = first or now
            if now - first > _TOGETHER:
                click.echo("interrupted again: the render is given up", err=True)
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
