"""A thread that works on the newest of each kind of item."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any


class Mailbox:
    """Hands items to a function in a thread of its own. Whoever puts an item never waits: if the
    function takes long, or forever, later items of a name replace earlier ones.

    Parameters:
        take: A function of a name and the newest item of this name.
        spent: A function that is called with the time of each call of ``take``, in seconds.
        failed: A function that is called with an exception of ``take``.
        clock: Measures the time; by default, the CPU time of the thread, without waiting.
    """

    def __init__(
        self, take: Callable[[str, Any], None],
        spent: Callable[[float], None] = lambda seconds: None,
        failed: Callable[[Exception], None] = lambda error: None,
        clock: Callable[[], float] = time.thread_time,
    ) -> None:  # fmt: skip
        self._take, self._spent, self._failed = take, spent, failed
        self._clock = clock
        self._items: dict[str, Any] = {}
        self._is_working = self._is_closed = False
        self._changed = threading.Condition()
        threading.Thread(target=self._work, daemon=True).start()

    def put(self, name: str, item: Any) -> None:
        with self._changed:
            self._items[name] = item
            self._changed.notify_all()

    def close(self, seconds: float) -> bool:
        """Waits until all items are taken, but not longer than ``seconds``. Returns whether they
        are."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
            return self._changed.wait_for(lambda: not (self._items or self._is_working), seconds)

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._is_closed)
                if not self._items:
                    return
                name = next(iter(self._items))
                item, self._is_working = self._items.pop(name), True
            begin = self._clock()
            try:
                self._take(name, item)
            except Exception as error:  # such as too little memory
                self._failed(error)
            finally:
                with self._changed:
                    self._is_working = False
                    self._changed.notify_all()
            del item  # it may be large
            self._spent(self._clock() - begin)
