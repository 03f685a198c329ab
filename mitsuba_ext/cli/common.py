"""What the commands share: kinds of options, the variant, progress bars, the terminal."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

#: Exit code after Ctrl-C.
INTERRUPTED = 130

MAX_SEED = 2**32 - 1

#: Width of tables that go to a file or a pipe, where there is no terminal to ask.
_PIPE_WIDTH = 160


class Size(click.ParamType):
    name = "size"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)x(\d+)", value)
        if not match or not int(match.group(1)) or not int(match.group(2)):
            self.fail(f'expected something like 640x360, found "{value}"', param, ctx)
        return int(match.group(1)), int(match.group(2))


class Definition(click.ParamType):
    name = "key=value"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, str]:
        key, equals, text = value.partition("=")
        if not key or not equals:
            self.fail(f'expected key=value, found "{value}"', param, ctx)
        return key, text


def scene_options(command: Callable) -> Callable:
    """What ``render`` and ``compare`` share."""
    for decorator in (
        click.option(
            "--size", type=Size(), metavar="WxH",
            help="Size of the image, instead of the film's.",
        ),
        click.option(
            "-D", "definitions", type=Definition(), multiple=True, metavar="KEY=VALUE",
            help="A $KEY parameter of the scene file. Can be repeated.",
        ),
        click.option(
            "--variant", default="llvm_ad_rgb", show_default=True, help="Mitsuba's variant."
        ),
        click.argument("scene", type=click.Path(path_type=Path)),
    ):
        command = decorator(command)
    return command


def select_variant(variant: str) -> None:
    import mitsuba as mi

    from ..scenes import InputError, one_line

    if variant not in mi.variants():
        raise InputError(f'unknown variant "{variant}" (there are: {", ".join(mi.variants())})')
    try:
        mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        raise InputError(f'the variant "{variant}" does not start: {one_line(error)}') from error


def make_folder(folder: Path) -> None:
    from ..scenes import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder ({error.strerror})") from error


@contextlib.contextmanager
def progress_bars() -> Iterator[Progress]:
    """A progress bar on stderr, if that is a terminal."""
    from rich import progress as bars
    from rich.console import Console

    terminal = sys.stderr.isatty()
    console = Console(stderr=True, quiet=not terminal)
    columns = (
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.TimeElapsedColumn(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(
        *columns, console=console, disable=not terminal, transient=True
    ) as progress:
        yield progress


def console_for_tables() -> Console:
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)
