"""The output of a render, during it and at its end, for people or for scripts."""

from __future__ import annotations

import contextlib
import datetime
import json
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click
from rich.progress import Progress, TextColumn

from ..compare.progress import progress_bars
from .common import say

if TYPE_CHECKING:
    from ..live.viewer import Viewer

#: The minimum time between two progress events, in seconds.
_PERIOD = 1.0


class Report:
    """Sentences and progress bars on the terminal, or events: JSON objects on stdout, one per line.

    Parameters:
        is_quiet: Whether to show only warnings and errors.
        as_json: Whether to print events instead of sentences and bars.
    """

    def __init__(self, is_quiet: bool = False, as_json: bool = False) -> None:
        self._is_quiet, self._as_json = is_quiet, as_json
        self._last = -_PERIOD
        self._events = sys.stdout
        #: Who else is told of the progress.
        self.viewer: Viewer | None = None
        #: The image whose progress is reported; empty if there is only one.
        self.image: dict[str, Any] = {}

    def note(self, text: str) -> None:
        """Prints an informative sentence on stderr."""
        if not self._is_quiet and not self._as_json:
            say(text)

    def warn(self, text: str) -> None:
        if self._as_json:
            self._event("warning", text=text)
        else:
            say(f"mitsuba-ext: warning: {text}")

    def progress(self, **figures: Any) -> None:
        """Emits a progress event; figures that are ``None`` are omitted. A viewer that has paused
        the render holds it here."""
        if self.viewer:
            self.viewer.tell(**figures)
        if self._as_json and not self._is_quiet and time.monotonic() - self._last >= _PERIOD:
            self._last = time.monotonic()
            self._event("progress", **self.image, **figures)

    def page(self, address: str) -> None:
        """Names the page that shows the render, even in a quiet report."""
        if self._as_json:
            self._event("page", address=address)
        else:
            say(f"the render is shown at {address}")

    def end(
        self, text: str, details: Sequence[str] = (), is_interrupted: bool = False, **figures: Any
    ) -> None:
        """Prints the last sentence or event. A quiet report omits the details."""
        if self._as_json:
            self._event("end", interrupted=is_interrupted, **figures)
        elif is_interrupted or not self._is_quiet:
            say("\n".join([text, *([] if self._is_quiet else details)]), err=is_interrupted)

    @contextlib.contextmanager
    def bars(self) -> Iterator[Progress]:
        """Progress bars, if a terminal shows them. The field ``left`` of their tasks is the text of
        :func:`time_left`."""
        column = TextColumn("{task.fields[left]}", markup=False)
        with progress_bars(column, is_shown=not self._is_quiet and not self._as_json) as bars:
            yield bars

    @contextlib.contextmanager
    def only_events(self) -> Iterator[None]:
        """A context in which stdout has only events: Mitsuba's warnings become events, and the
        output of the user's modules goes to stderr. Without events, it does nothing."""
        if not self._as_json:
            yield
            return
        import mitsuba as mi

        report = self

        class Warnings(mi.Appender):
            def append(self, level: mi.LogLevel, text: str) -> None:
                if level.value >= mi.LogLevel.Warn.value:
                    report.warn(text)

            def log_progress(self, *_arguments: Any) -> None:
                pass

        logger, formatter = mi.logger(), mi.DefaultFormatter()
        formatter.set_has_date(False)
        formatter.set_has_log_level(False)
        before = logger.formatter(), [logger.appender(n) for n in range(logger.appender_count())]
        logger.clear_appenders()
        logger.add_appender(Warnings())
        logger.set_formatter(formatter)
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield
        finally:
            logger.clear_appenders()
            for appender in before[1]:
                logger.add_appender(appender)
            logger.set_formatter(before[0])

    def _event(self, event: str, **figures: Any) -> None:
        known = {key: value for key, value in figures.items() if value is not None}
        with contextlib.suppress(OSError):  # like say()
            click.echo(json.dumps({"event": event, **known}), file=self._events)


def time_left(seconds: float | None) -> str:
    """The remaining time as text; empty if it is unknown."""
    return "" if seconds is None else f"about {datetime.timedelta(seconds=round(seconds))} left"


class Speed:
    """Measures the speed of a render from one call to the next. The time before the first call is
    excluded, because it may include compilation."""

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None

    def __call__(self, done: float) -> float | None:
        """The progress per second; ``None`` while it is unknown.

        Args:
            done: The amount done, in any unit.
        """
        now = time.perf_counter()
        if self._first is None:
            self._first = now, done
        begin, before = self._first
        return (done - before) / (now - begin) if done > before and now > begin else None
