"""The options that show a render while it runs, of several commands."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Protocol

import click

from .common import say

if TYPE_CHECKING:
    from ..compare.runs import Run
    from ..live.snapshot import Snapshot
    from ..live.viewer import Viewer

#: Where tev listens by default.
TEV = "127.0.0.1:14158"


class Output(Protocol):
    """Prints what the viewer says."""

    viewer: Viewer | None

    def page(self, address: str) -> None: ...

    def warn(self, text: str) -> None: ...


class Sayings:
    """An output that prints everything on stderr."""

    viewer: Viewer | None = None

    def page(self, address: str) -> None:
        say(f"shown at {address}")

    def warn(self, text: str) -> None:
        say(f"mitsuba-ext: warning: {text}")


class CommandWithTev(click.Command):
    """A command whose option ``--tev`` may have no value, also before an argument."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        for index, text in enumerate(args):
            if text == "--":
                break
            following = args[index + 1] if index + 1 < len(args) else ""
            if text == "--tev" and not re.fullmatch(r"[^\s:/]*:\d+", following):
                args[index] = f"--tev={TEV}"
        return super().parse_args(ctx, args)


def view_options(what: str) -> Callable:
    """Adds the options that show ``what`` while it runs."""

    def decorator(command: Callable) -> Callable:
        for option in (
            click.option(
                "--control", is_flag=True,
                help="With --serve: the page can pause and stop. The address that is printed has a "
                "key for that.",
            ),
            click.option(
                "--serve", "port", type=click.IntRange(0, 65535), metavar="PORT",
                help=f"Show {what} on a web page of this machine, at http://127.0.0.1:PORT; 0 "
                "takes any free port. The address is printed.",
            ),
            click.option(
                "--tev", metavar="[HOST:PORT]",
                help=f"Show {what} in the image viewer tev.  [default: {TEV}]",
            ),
        ):  # fmt: skip
            command = option(command)
        return command

    return decorator


@contextlib.contextmanager
def viewing(
    tev: str | None, port: int | None, control: bool, output: Output
) -> Iterator[Viewer | None]:
    """A context in which renders are shown; yields ``None`` if nobody wants to see them.

    Raises:
        InputError: An address or a port cannot be used, or a package is missing.
    """
    if control and port is None:
        raise click.UsageError("--control needs --serve: the page that pauses and stops the render")
    if tev is None and port is None:
        yield None
        return
    from ..live.viewer import FINISHED, INTERRUPTED, open_viewer

    viewer, address = open_viewer(tev, port, control, output.warn)
    if address:
        output.page(address)
    output.viewer = viewer
    phase = INTERRUPTED
    try:
        yield viewer
        phase = FINISHED
    finally:
        output.viewer = None
        viewer.close(INTERRUPTED if viewer.is_interrupted else phase)


def of_runs(runs: Sequence[Run]) -> Snapshot:
    """A snapshot of the mean of the runs of an integrator at one level; its variance is the one
    between seeds, and its error the mean of their errors."""
    import numpy as np

    from ..live.snapshot import Snapshot

    images = np.stack([run.image() for run in runs])
    errors = [run.errors.relmse for run in runs if run.errors]
    newest, count = runs[-1], len(runs)
    return Snapshot(
        images.mean(axis=0), ("R", "G", "B"), 3, newest.spp,
        sum(run.seconds for run in runs) / count,
        variance=images.var(axis=0, ddof=1) / count if count > 1 else None,
        error=sum(errors) / count if errors else None, learned=newest.learned,
        is_error_measured=bool(errors),
    )  # fmt: skip
