"""Handles the signals that ask a process to end, and defers Ctrl-C to the end of a pass.

This module does not import Mitsuba at the top: the command line installs its handlers before that.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

#: Signals of Ctrl-C, of batch systems some seconds before they kill, and of a closed terminal.
SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]

#: The signal that asks a long render to save its current state; ``None`` on systems without it.
KEEP: int | None = getattr(signal, "SIGUSR1", None)

#: Signals within this number of seconds after the first one are ignored. A terminal that is closed
#: may send several, and some launchers forward a Ctrl-C that the terminal also sends to this
#: process.
TOGETHER = 0.5


class Signalled(KeyboardInterrupt):
    """Raised for a signal.

    Attributes:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


class InterruptHandler:
    """A handler for some of :data:`SIGNALS`. The first signal sets :attr:`event`, or raises
    ``KeyboardInterrupt`` if there is none; a second one raises ``KeyboardInterrupt``.

    Attributes:
        number: The first signal; ``None`` if none was received yet.
        event: During a pass, the event that the first signal sets instead of interrupting the pass;
            otherwise ``None``.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.event: threading.Event | None = None
        self._time = 0.0

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.number is None:
            self.number, self._time = number, now
        elif now - self._time <= TOGETHER:
            return
        if self.event is None or self.event.is_set():
            raise Signalled(number)
        self.event.set()
        import mitsuba as mi

        mi.Log(mi.LogLevel.Warn, "Interrupted: finishing the running pass.")


def is_end_requested() -> bool:
    """Whether a signal has asked the running render to end after its pass."""
    handlers = [signal.getsignal(number) for number in SIGNALS]
    events = [handler.event for handler in handlers if isinstance(handler, InterruptHandler)]
    return any(event is not None and event.is_set() for event in events)


def request_end() -> None:
    """Ends the render of this process as Ctrl-C does. Any thread may call this."""
    heard = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    if heard:
        os.kill(os.getpid(), heard[0])


def interrupted(plugin: str) -> KeyboardInterrupt:
    """What a render raises that Ctrl-C has ended: ``mi.render`` turns it into a ``RuntimeError``,
    whose cause then says where the image is."""
    return KeyboardInterrupt(
        f'"{plugin}": Ctrl-C ended the render; the film holds the image of the finished passes: '
        f"scene.sensors()[0].film().develop()"
    )


@contextlib.contextmanager
def requests_to_keep(
    handler: Callable[[int, FrameType | None], None] | signal.Handlers,
) -> Iterator[None]:
    """A context in which :data:`KEEP` has a handler. Without one, the signal ends the process."""
    if KEEP is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(KEEP, handler)
    try:
        yield
    finally:
        signal.signal(KEEP, before)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """While active, the first Ctrl-C only sets the event, so that the running pass can finish; a
    second one interrupts at once (or as soon as Mitsuba returns to Python). If an
    :class:`InterruptHandler` is active already, all of its signals act like Ctrl-C."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    handlers = [signal.getsignal(number) for number in SIGNALS]
    active = [handler for handler in handlers if isinstance(handler, InterruptHandler)]
    with contextlib.ExitStack() as stack:
        if active:
            handler = active[0]
        else:
            handler = InterruptHandler()
            stack.enter_context(handling([signal.SIGINT], handler))
        before, handler.event = handler.event, event
        try:
            yield event
        finally:
            handler.event = before


@contextlib.contextmanager
def handling(
    numbers: Sequence[int], handler: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """While active, ``handler`` is called for each of the signals, except for those that were
    ignored before (``nohup`` ignores SIGHUP, and a script's shell SIGINT in background jobs)."""
    previous = {number: signal.getsignal(number) for number in numbers}
    handled = [number for number in numbers if previous[number] is not signal.SIG_IGN]
    for number in handled:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, previous[number] or signal.SIG_DFL)
