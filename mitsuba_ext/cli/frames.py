"""The images that a call of ``render`` makes: one for each frame and sensor."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click

from ..util.errors import InputError
from .common import MAX_SEED

#: The functions and constants available in expressions, besides the frame number.
_FUNCTIONS = {
    **{name: value for name, value in vars(math).items() if not name.startswith("_")},
    "abs": abs, "min": min, "max": max, "round": round, "int": int,
}  # fmt: skip


class FrameRange(click.ParamType):
    name = "frames"

    def convert(self, value: Any, param: Any, ctx: Any) -> range:
        if isinstance(value, range):
            return value
        match = re.fullmatch(r"(\d+):(\d+)", value)
        if not match or int(match[1]) > int(match[2]):
            self.fail(f'expected something like 1:100, found "{value}"', param, ctx)
        return range(int(match[1]), int(match[2]) + 1)


class Sensors(click.ParamType):
    """Indices of sensors; an empty tuple for all sensors."""

    name = "sensors"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        if not re.fullmatch(r"all|\d+(,\d+)*", value):
            self.fail(f'expected something like 0, 0,2 or all, found "{value}"', param, ctx)
        return () if value == "all" else tuple(map(int, value.split(",")))


class Picture(NamedTuple):
    """One of the images.

    Attributes:
        output: The file of the image.
        definitions: Values of the scene's ``$name`` parameters.
        sensor: The index of the sensor; ``None`` for the first.
        seed: Seed of the random numbers.
        frame: The frame number; ``None`` if there are no frames.
        name: The part of the file name for its frame and sensor; empty for a single image.
    """

    output: Path
    definitions: tuple[tuple[str, str], ...]
    sensor: int | None
    seed: int
    frame: int | None = None
    name: str = ""

    @property
    def unfinished(self) -> Path:
        """The file of the unfinished image."""
        return self.output.with_name(f"{self.output.stem}.partial{self.output.suffix}")


def pictures(
    output: Path, definitions: Sequence[tuple[str, str]], sensors: Sequence[int | None],
    seed: int, frames: range | None,
) -> Iterator[Picture]:  # fmt: skip
    """The images, frame by frame.

    Args:
        output: The file, with ``#`` for each digit of the frame.
        definitions: Values of ``$name`` parameters; with frames, ``{…}`` in a value is an
            expression of ``frame``.
        sensors: The indices of the sensors. If there are several, file names contain them.
        seed: The seed of frame 0. Frame n adds n, because with equal seeds, noise would visibly
            stay in place.
        frames: The frame numbers; ``None`` for a single image.

    Raises:
        InputError: The file name has no place for the frame number, or an expression is invalid.
    """
    if frames is not None and len(re.findall("#+", output.name)) != 1:
        raise InputError(f"{output}: needs a place for the frame number: image.####.exr")
    for frame in [None] if frames is None else frames:
        file, values, names = output, tuple(definitions), []
        if frame is not None:
            digits = re.sub("#+", lambda m, f=frame: str(f).zfill(len(m[0])), output.name)
            file = output.with_name(digits)
            names.append(str(frame).zfill(output.name.count("#")))
            values = tuple((key, _evaluated(text, frame)) for key, text in definitions)
        for sensor in sensors:
            own = [f"sensor{sensor}"] if len(sensors) > 1 else []
            name = ".".join([file.stem, *own]) + file.suffix
            yield Picture(
                file.with_name(name), values, sensor, (seed + (frame or 0)) % (MAX_SEED + 1),
                frame, ".".join([*names, *own]),
            )  # fmt: skip


def _evaluated(text: str, frame: int) -> str:
    def value(match: re.Match) -> str:
        try:
            # The expression is from the user's own command line
            return str(eval(match[1], {"__builtins__": {}, **_FUNCTIONS, "frame": frame}))
        except Exception as error:  # the expression may raise anything
            raise InputError(f'"{text}": frame {frame}: {error}') from None

    return re.sub(r"\{([^{}]*)\}", value, text)
