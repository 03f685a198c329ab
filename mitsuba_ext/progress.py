"""What long work says meanwhile, on stderr: bars on a terminal, lines elsewhere."""

from __future__ import annotations

import contextlib
import datetime
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

#: Where there is no terminal, lines are at least so many seconds apart.
PERIOD = 30.0


class Step(NamedTuple):
    """Where a comparison is; what ``progress`` is called with.

    Attributes:
        label: What is being done.
        done: Seconds of work that are behind (measured ones, not the clock's).
        left: Seconds that are estimated to be left; ``None`` while nothing is known.
    """

    label: str
    done: float
    left: float | None


@contextlib.contextmanager
def reporting(progress: bool | Callable[[Step], None]) -> Iterator[Callable[[Step], None]]:
    """What to call with each step: ``progress`` itself, or for ``True`` what shows a bar with an
    estimate of the time left (lines, where there is no terminal), for ``False`` nothing."""
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
def progress_bars(*columns: ProgressColumn) -> Iterator[Progress]:
    """Progress bars on stderr, if that is a terminal.

    Args:
        columns: What follows the label, the bar and the time; default: rich's estimate of the rest.
    """
    from rich import progress as bars
    from rich.console import Console

    terminal = sys.stderr.isatty()
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
