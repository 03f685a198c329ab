"""Shows the progress of long work on stderr: as bars on a terminal, as lines elsewhere."""

from __future__ import annotations

import contextlib
import datetime
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

#: The minimum time between two lines without a terminal, in seconds.
PERIOD = 30.0


class Step(NamedTuple):
    """The progress of a comparison, passed to the function ``progress``.

    Attributes:
        label: The current activity.
        done: Measured seconds of the finished renders.
        left: Estimated seconds of the remaining renders; ``None`` if unknown.
    """

    label: str
    done: float
    left: float | None


@contextlib.contextmanager
def reporting(progress: bool | Callable[[Step], None]) -> Iterator[Callable[[Step], None]]:
    """Yields the function to call with each step: ``progress`` itself if it is a function. For
    ``True``, a function that shows a bar with an estimate of the time left (lines, without a
    terminal); for ``False``, a function that does nothing."""
    if callable(progress):
        yield progress
    elif not progress:
        yield lambda _step: None
    elif not sys.stderr.isatty():
        yield _Log()
    else:
        with _bar() as show:
            yield show


@contextlib.contextmanager
def progress_bars(*columns: ProgressColumn, is_shown: bool = True) -> Iterator[Progress]:
    """Progress bars on stderr, if that is a terminal.

    Args:
        columns: Columns after the label, the bar and the elapsed time. By default, rich's estimate
            of the remaining time.
        is_shown: ``False`` hides the bars.
    """
    from rich import progress as bars
    from rich.console import Console

    terminal = is_shown and sys.stderr.isatty()
    console = Console(stderr=True, quiet=not terminal)
    columns = (
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.TimeElapsedColumn(),
        *(columns or [bars.TimeRemainingColumn()]),
    )
    with bars.Progress(
        *columns, console=console, disable=not terminal, transient=True
    ) as progress:
        yield progress


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[Step], None]]:
    from rich.progress import TextColumn

    with progress_bars(TextColumn("{task.fields[left]}", markup=False)) as bars:
        bar = bars.add_task("loading", total=None, left="")

        def show(step: Step) -> None:
            total = None if step.left is None else max(step.done + step.left, 1e-9)
            bars.update(
                bar, description=step.label, total=total, completed=step.done, left=_left(step)
            )

        yield show


class _Log:
    """Steps as lines that are at least :data:`PERIOD` seconds apart."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def __call__(self, step: Step) -> None:
        if time.monotonic() - self._last >= PERIOD:
            self._last = time.monotonic()
            print(", ".join(filter(None, [step.label, _left(step)])), file=sys.stderr, flush=True)


def _left(step: Step) -> str:
    if step.left is None:
        return ""
    return f"about {datetime.timedelta(seconds=round(step.left))} left"
