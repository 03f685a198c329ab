"""Option types and terminal output shared by the commands."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..long_renders.intervals import Interval
from . import candidates

if TYPE_CHECKING:
    from rich.console import Console

#: The exit code after Ctrl-C.
INTERRUPTED = 130

MAX_SEED = 2**32 - 1

#: The maximum number of threads of a process.
MAX_THREADS = 1024

#: The width of tables written to a file or a pipe, in characters.
_PIPE_WIDTH = 160


class SizeType(click.ParamType):
    name = "size"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+)x(\d+)", value)
        if not match or not int(match.group(1)) or not int(match.group(2)):
            self.fail(f'expected something like 640x360, found "{value}"', param, ctx)
        return int(match.group(1)), int(match.group(2))


class CropType(click.ParamType):
    name = "crop"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)\+(\d+)\+(\d+)", value)
        if not match:
            self.fail(f'expected something like 64x36+100+20, found "{value}"', param, ctx)
        return tuple(map(int, match.groups()))


class PixelType(click.ParamType):
    name = "pixel"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        match = re.fullmatch(r"(\d+),(\d+)", value)
        if not match:
            self.fail(f'expected a column and a row like 120,45, found "{value}"', param, ctx)
        return int(match.group(1)), int(match.group(2))


class NumberList(click.ParamType):
    name = "numbers"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        if not re.fullmatch(r"[1-9]\d*(,[1-9]\d*)*", value):
            self.fail(f'expected something like 4,16,64, found "{value}"', param, ctx)
        return tuple(map(int, value.split(",")))


class IntervalType(click.ParamType):
    name = "interval"

    def convert(self, value: Any, param: Any, ctx: Any) -> Interval:
        try:
            return value if isinstance(value, Interval) else Interval.parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


class FilledPath(click.Path):
    """A path that is not empty. (``Path("")`` would be the current folder.)"""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: Any, ctx: Any) -> Path:
        if not str(value).strip():
            self.fail('expected a path, found ""', param, ctx)
        return super().convert(value, param, ctx)


class Definition(click.ParamType):
    name = "key=value"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, str]:
        key, equals, text = value.partition("=")
        key = key.lstrip("$")  # as the scene file names it
        if not key or not equals:
            self.fail(f'expected key=value, found "{value}"', param, ctx)
        return key, text


def scene_options(command: Callable) -> Callable:
    """Adds the options that ``render`` and ``compare`` share."""
    for decorator in (
        click.option(
            "--size", type=SizeType(), metavar="WxH",
            help="Size of the image, instead of the film's.",
        ),
        click.option(
            "--crop", type=CropType(), metavar="WxH+X+Y",
            help="Render W by H pixels of the image, starting at column X and row Y.",
        ),
        click.option(
            "--filter", "rfilter", default="", metavar="FILTER",
            shell_complete=candidates.filters,
            help="Reconstruction filter, instead of the film's: NAME[:key=value,…], such as box or "
            "gaussian:stddev=0.4.",
        ),
        click.option(
            "--max-depth", type=click.IntRange(min=-1), metavar="N",
            help="Maximum depth of paths, instead of the scene's; -1 for no limit. An INTEGRATOR "
            "that sets max_depth keeps it.",
        ),
        click.option(
            "-D", "definitions", type=Definition(), multiple=True, metavar="KEY=VALUE",
            help="A $KEY parameter of the scene file. Can be repeated.",
        ),
        click.option(
            "--plugin", "plugins", multiple=True, metavar="MODULE",
            shell_complete=candidates.modules,
            help="A Python module, or its .py file, that registers your own integrators. Can be "
            "repeated.",
        ),
        click.option(
            "--variant", default="llvm_ad_rgb", show_default=True, help="Mitsuba's variant.",
            shell_complete=candidates.variants,
        ),
    ):
        command = decorator(command)
    return command


def executor_options(what: str, note: str = "") -> Callable:
    """Adds the options ``--workers`` and ``--dask``, which choose where ``what`` is done."""

    def decorator(command: Callable) -> Callable:
        dask = click.option(
            "--dask", metavar="ADDRESS",
            help=f"{what} on the workers of the Dask scheduler at ADDRESS: tcp://host:port.",
        )  # fmt: skip
        workers = click.option(
            "--workers", type=click.IntRange(1, 1024), metavar="N",
            help=f"{what} in N processes of this machine.{note}",
        )  # fmt: skip
        return workers(dask(command))

    return decorator


def check_executor(workers: int | None, dask: str | None) -> None:
    """
    Raises:
        click.UsageError: Both options are given.
    """
    if workers is not None and dask is not None:
        raise click.UsageError("--workers and --dask cannot be combined")


def kernels_compiled() -> int:
    """The number of kernels that this process had to compile because Dr.Jit's cache lacked them."""
    import drjit as dr

    _launches, _loaded, compiled = dr.detail.launch_stats()
    return compiled


def say(text: str, err: bool = True) -> None:
    """Prints a line, on stderr or stdout. A closed terminal is ignored, so that the image is still
    written and the exit code stays the same."""
    with contextlib.suppress(OSError):
        click.echo(text, err=err)


def console_for_tables() -> Console:
    from rich.console import Console

    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)
