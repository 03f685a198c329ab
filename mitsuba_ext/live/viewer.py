"""Takes snapshots of renders, and hands them to receivers: the viewer tev, or a web page."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from ..rendering import interrupts
from ..util.errors import one_line
from .increments import Increments, estimated_error
from .mailbox import Mailbox
from .snapshot import Snapshot

if TYPE_CHECKING:
    import mitsuba as mi

    from ..rendering.statistics import RenderStatistics

#: The least time between two snapshots, in seconds.
_PERIOD = 0.5

#: The largest share of the time that snapshots take, with all that receivers do with them.
_SHARE = 1 / 80

#: The seconds for which the last snapshot may take after the render has ended.
_LAST_SECONDS = 5.0

#: The time between two looks at a paused render, in seconds.
_POLL = 0.05

#: What a render does, as receivers name it.
RENDERING, PAUSED, STOPPING, FINISHED, INTERRUPTED, FOLLOWING = (
    "rendering", "paused", "stopping", "finished", "interrupted", "following"
)  # fmt: skip


class Receiver(Protocol):
    """Whoever shows snapshots."""

    def receive(self, name: str, snapshot: Snapshot) -> None:
        """Shows a snapshot, in a thread of the receiver."""

    def begin(self) -> None:
        """Called when another image begins."""

    def describe(self, facts: dict[str, str]) -> None:
        """Called with what the image is, for people."""

    def tell(self, figures: dict[str, Any]) -> None:
        """Called often with figures of the progress: must return at once."""

    def close(self, phase: str) -> None:
        """Called once, at the end."""


class _Taken(NamedTuple):
    """A copy of a film, before its variance is known."""

    snapshot: Snapshot
    contents: np.ndarray | None
    weight_channel: int


class Viewer:
    """Shows the growing image of a render. It is the ``watch`` of our integrators
    (:class:`~mitsuba_ext.rendering.request.Watch`).

    A render waits only while the film is copied. Snapshots are taken so rarely that all work on
    them is little beside the render's.

    Parameters:
        receivers: Who shows the snapshots.
        warn: Called with a sentence if no snapshots can be taken.
        phase: What the render does.

    Attributes:
        phase: What the render does now.
        is_interrupted: Whether the render has ended before it had all samples; set by whoever
            renders.
    """

    def __init__(
        self, receivers: Sequence[Receiver], warn: Callable[[str], None] = lambda text: None,
        phase: str = RENDERING,
    ) -> None:  # fmt: skip
        self._receivers, self._warn = receivers, warn
        self._lock = threading.Lock()
        self.phase, self.is_interrupted = phase, False
        self._name, self._counts_samples = "", True
        self._is_first = self._is_free = True
        self._due, self._begin, self._is_broken = 0.0, time.monotonic(), False
        self._increments = Increments()
        self._boxes = [
            Mailbox(receiver.receive, self.spent, self._failed) for receiver in receivers
        ]
        # On a machine with other work, this takes longer, as the render does
        self._prepared = Mailbox(self._hand_on, self.spent, self._failed, time.perf_counter)

    # ---- Snapshots ----

    def begin(self, name: str, facts: dict[str, str], counts_samples: bool = True) -> None:
        """Another image begins.

        Args:
            name: The name of the image.
            facts: What it is, for people.
            counts_samples: Whether the film's weights count samples, so that its parts tell the
                variance.
        """
        self._name, self._counts_samples = name, counts_samples
        self._increments = Increments()
        self._due, self._begin, self._is_broken = 0.0, time.monotonic(), False
        for receiver in self._receivers:
            receiver.begin()
            receiver.describe(facts)

    def is_due(self) -> bool:
        """Whether it is time for a snapshot."""
        return time.monotonic() >= self._due and not self._is_broken

    def show(self, film: mi.Film, spp: int, statistics: RenderStatistics | None = None) -> None:
        """Takes a snapshot of a film. A render never fails because of it."""
        begin = time.monotonic()
        try:
            taken = self._taken(film, spp, statistics)
        except Exception as error:  # a film may raise anything
            self._failed(error)
            return
        self._wait_for_next(time.monotonic() - begin)
        self._prepared.put(self._name, (taken, self._increments))

    def present(self, make: Callable[[], Snapshot], name: str | None = None) -> None:
        """Shows a snapshot whose variance is known.

        Args:
            make: Makes the snapshot.
            name: The name of the image; ``None`` for the name that :meth:`begin` got.
        """
        begin = time.monotonic()
        try:
            snapshot = make()
        except Exception as error:  # such as a file that is damaged
            self._failed(error)
            return
        if not snapshot.seconds:
            snapshot = replace(snapshot, seconds=time.monotonic() - self._begin)
        self._wait_for_next(time.monotonic() - begin)
        for box in self._boxes:
            box.put(self._name if name is None else name, snapshot)

    def follow(
        self, name: str, facts: dict[str, str], snapshot: Snapshot, figures: dict[str, Any]
    ) -> None:
        """Shows a snapshot of a render of another process."""
        self._name = name
        for receiver in self._receivers:
            receiver.describe(facts)
            receiver.tell(figures)
        self.present(lambda: snapshot)

    def tell(self, **figures: Any) -> None:
        """Tells receivers how far the render is. Returns when it is not paused."""
        for receiver in self._receivers:
            receiver.tell(figures)
        self.wait_while_paused()

    def close(self, phase: str = FINISHED) -> None:
        """Ends all: the last snapshots are shown, unless that takes long."""
        self.phase = phase
        boxes = [self._prepared, *self._boxes]
        if not all([box.close(_LAST_SECONDS) for box in boxes]):
            self._warn("not all snapshots could be shown: the viewer did not take them")
        for receiver in self._receivers:
            receiver.close(phase)

    def spent(self, seconds: float) -> None:
        """Delays the next snapshot, because the last one took ``seconds`` of CPU time, which the
        render did not get."""
        self._delay(seconds / (os.cpu_count() or 1))

    # ---- Pause and stop ----

    def pause(self) -> None:
        """Makes the render wait after the running pass."""
        with self._lock:
            if self.phase == RENDERING:
                self.phase = PAUSED

    def resume(self) -> None:
        with self._lock:
            if self.phase == PAUSED:
                self.phase = RENDERING

    def stop(self) -> None:
        """Ends the render as Ctrl-C does. (A second Ctrl-C would discard the image.)"""
        with self._lock:
            if self.phase not in (RENDERING, PAUSED):
                return
            self.phase = STOPPING
        interrupts.request_end()

    def wait_while_paused(self) -> None:
        """Returns when the render is not paused, or when a signal asks it to end."""
        while self.phase == PAUSED and not interrupts.is_end_requested():
            time.sleep(_POLL)

    # ---- Helpers ----

    def _wait_for_next(self, seconds: float) -> None:
        # The first snapshot may compile kernels
        self._is_free, self._is_first = self._is_first, False
        self._due = time.monotonic() + _PERIOD
        self._delay(seconds)

    def _failed(self, error: Exception) -> None:
        """Takes no more snapshots of this render, and says why."""
        if not self._is_broken:
            self._is_broken = True
            self._warn(f"the unfinished image cannot be shown: {one_line(error)}")

    def _delay(self, seconds: float) -> None:
        if not self._is_free:
            self._due += seconds / _SHARE

    def _taken(self, film: mi.Film, spp: int, statistics: RenderStatistics | None) -> _Taken:
        import mitsuba as mi

        image = np.array(film.develop(), dtype=np.float32)
        names = tuple(entry.name for entry in film.bitmap().struct_())
        snapshot = Snapshot(
            image, names, film.base_channels_count(), spp, time.monotonic() - self._begin,
            learned=statistics.learned if statistics else "",
            effects=dict(statistics.effects) if statistics else {},
        )  # fmt: skip
        is_special = mi.has_flag(film.flags(), mi.FilmFlags.Special)
        if is_special or not self._counts_samples or names[:3] != ("R", "G", "B"):
            return _Taken(snapshot, None, 0)
        weight = 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
        contents = np.array(film.develop(raw=True), dtype=np.float32)[..., : weight + 1]
        return _Taken(snapshot, contents, weight)

    def _hand_on(self, name: str, item: tuple[_Taken, Increments]) -> None:
        """Adds the variance to a snapshot, and hands it to all receivers."""
        (snapshot, contents, weight_channel), increments = item
        if contents is not None:
            increments.add(contents, weight_channel, snapshot.spp)
            variance = increments.variance()
            if variance is not None:
                error = estimated_error(snapshot.image[..., :3], variance)
                snapshot = replace(snapshot, variance=variance, error=error)
        for box in self._boxes:
            box.put(name, snapshot)


def open_viewer(
    tev: str | None, port: int | None, has_control: bool, warn: Callable[[str], None],
    phase: str = RENDERING,
) -> tuple[Viewer, str]:  # fmt: skip
    """A viewer, and the address of its web page; empty if there is none.

    Args:
        tev: Where tev listens; ``None`` without tev.
        port: The port of a web page; ``None`` without one.
        has_control: Whether the page can pause and stop the render.
        warn: Called with sentences about what does not work.
        phase: What the render does.

    Raises:
        InputError: The address or the port cannot be used, or a package is missing.
    """
    from .server import WebReceiver
    from .tev import TevReceiver

    receivers: list[Receiver] = [] if tev is None else [TevReceiver(tev, warn)]
    page = None if port is None else WebReceiver(port)
    viewer = Viewer([*receivers, *([page] if page else [])], warn, phase)
    if page is None:
        return viewer, ""
    page.serve(viewer, has_control)
    return viewer, page.address
