"""Renders of several threads that share an integrator or a film take turns.

A render keeps what it learns, and its statistics, in the integrator, and puts its image into the
film of the sensor.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import mitsuba as mi

from ..scene.nesting import with_nested


class _Turn:
    """Whose turn it is to use an object.

    Attributes:
        lock: Held by the thread that uses it.
        count: Renders that use it, or wait for it.
    """

    def __init__(self) -> None:
        self.lock, self.count = threading.RLock(), 0


_lock = threading.Lock()
_turns: dict[int, _Turn] = {}


@contextmanager
def in_turn(integrator: mi.Integrator, sensor: mi.Sensor) -> Iterator[None]:
    """A context in which no other thread renders with the integrator, with one that is nested in
    it, or into the film of the sensor. It begins as soon as others have ended."""
    with ExitStack() as stack:
        # All threads in the same order: none waits for one that waits for it
        for place in sorted({each.ptr for each in (*with_nested(integrator), sensor.film())}):
            stack.enter_context(_in_turn(place))
        yield


@contextmanager
def _in_turn(place: int) -> Iterator[None]:
    with _lock:
        turn = _turns.setdefault(place, _Turn())
        turn.count += 1
    try:
        with turn.lock:
            yield
    finally:
        with _lock:
            turn.count -= 1
            if turn.count == 0:
                del _turns[place]
