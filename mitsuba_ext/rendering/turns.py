"""Renders of several threads take turns.

Dr.Jit 1.5.0 has faults where two threads trace and evaluate at once (rarely, an image lacks a
part), and uses all processors for each kernel. So one thread renders at a time, and lets others
render a pass between two of its own (:func:`let_others`).

Besides, a render keeps what it learns, and its statistics, in the integrator, and puts its image
into the film of the sensor: renders that share one of these follow each other.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import mitsuba as mi

from ..scene.nesting import with_nested


class _Turns:
    """Whose turn it is. Threads wait in the order in which they came."""

    def __init__(self) -> None:
        self._lock, self._is_taken = threading.Lock(), False
        self._waiting: deque[threading.Lock] = deque()

    def take(self) -> None:
        """Waits for a turn."""
        with self._lock:
            if not self._is_taken:
                self._is_taken = True
                return
            handed_over = threading.Lock()
            handed_over.acquire()
            self._waiting.append(handed_over)
        try:
            handed_over.acquire()
        except BaseException:  # Ctrl-C
            with self._lock:
                if handed_over in self._waiting:
                    self._waiting.remove(handed_over)
                else:
                    self._hand_over()
            raise

    def give(self) -> None:
        """Ends a turn."""
        with self._lock:
            self._hand_over()

    def pause(self) -> None:
        """Gives, and takes again, if others wait."""
        if self._waiting:
            self.give()
            self.take_again()

    def take_again(self) -> None:
        """Waits for a turn that was given. An exception meanwhile is raised in turn."""
        error = None
        while True:
            try:
                self.take()
                break
            except BaseException as caught:
                error = caught
        if error is not None:
            raise error

    def _hand_over(self) -> None:
        if self._waiting:
            self._waiting.popleft().release()
        else:
            self._is_taken = False


class _Thread(threading.local):
    """The renders of a thread, each within the one before."""

    depth = 0


class _Shared:
    """An object that renders share.

    Attributes:
        lock: Held by the thread that uses it.
        count: Renders that use it, or wait for it.
    """

    def __init__(self) -> None:
        self.lock, self.count = threading.RLock(), 0


_turns, _thread = _Turns(), _Thread()
_lock = threading.Lock()
_shared: dict[int, _Shared] = {}


@contextmanager
def in_turn(
    integrator: mi.Integrator, sensor: mi.Sensor, begin: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """A context in which no other thread renders, except in :func:`let_others`; and there, none
    with the integrator, with one that is nested in it, or into the film of the sensor. ``begin`` is
    called when these are no longer used, before the turn."""
    with ExitStack() as stack:
        # All threads in the same order, and before their turn: none waits for one that waits for it
        for place in sorted({each.ptr for each in (*with_nested(integrator), sensor.film())}):
            stack.enter_context(_used(place))
        begin()
        if _thread.depth == 0:
            _turns.take()
        _thread.depth += 1
        try:
            yield
        finally:
            _thread.depth -= 1
            if _thread.depth == 0:
                _turns.give()


def let_others() -> None:
    """Lets other threads render a pass, if they wait for it."""
    if _thread.depth > 0:
        _turns.pause()


def tell(progress: Callable[[float], None], done: float) -> None:
    """Calls ``progress`` of a render. It may render, or wait for threads that do: meanwhile, this
    thread has no turn."""
    depth, _thread.depth = _thread.depth, 0
    if depth > 0:
        _turns.give()
    try:
        progress(done)
    finally:
        if depth > 0:
            _turns.take_again()
        _thread.depth = depth


@contextmanager
def _used(place: int) -> Iterator[None]:
    with _lock:
        shared = _shared.setdefault(place, _Shared())
        shared.count += 1
    try:
        with shared.lock:
            yield
    finally:
        with _lock:
            shared.count -= 1
            if shared.count == 0:
                del _shared[place]
