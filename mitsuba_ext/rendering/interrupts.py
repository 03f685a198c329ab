"""The signals that ask a process to end, and Ctrl-C between two passes of a render.

Nothing here imports Mitsuba: the command line installs handlers before it does.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType

#: Ctrl-C; what batch systems send some seconds before they kill; what a closed terminal sends.
SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]

#: Signals that come within so many seconds of the first one count as one: a terminal that is closed
#: may send several, and some launchers pass on a Ctrl-C that the terminal sends to both processes.
TOGETHER = 0.5


class InterruptHandler:
    """A handler for some of :data:`SIGNALS`. The first signal raises ``KeyboardInterrupt``, or only
    sets an event if there is one; a second one raises ``KeyboardInterrupt``.

    Attributes:
        number: The first signal; ``None`` if none came yet.
        event: What the first signal sets, as long as a pass must not be interrupted.
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
            raise KeyboardInterrupt
        self.event.set()
        import mitsuba as mi

        mi.Log(mi.LogLevel.Warn, "Interrupted: the running pass is being finished.")


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """While active, the first Ctrl-C only sets the event, so that the running pass can finish; a
    second one interrupts at once (or as soon as Mitsuba returns to Python). Where an
    :class:`InterruptHandler` is active already, its signals do the same."""
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
    """While active, ``handler`` is called for each of the signals, except for those that are
    ignored: by ``nohup``, or SIGINT by a shell that runs a script's job in the background."""
    previous = {number: signal.getsignal(number) for number in numbers}
    handled = [number for number in numbers if previous[number] is not signal.SIG_IGN]
    for number in handled:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, previous[number] or signal.SIG_DFL)
