"""``mitsuba-ext diff``: measures the difference between two images."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .common import FilledPath, console_for_tables

if TYPE_CHECKING:
    import numpy as np

    from ..compare import Errors

_FIGURES = {
    "relmse": "relMSE",
    "relmse_trimmed": "relMSE, trimmed",
    "relmse_worst": "relMSE, 99th percentile",
    "mse": "MSE",
    "rmse": "rMSE",
    "sigma_mu": "σ/μ",
    "flip": "FLIP",
}


@click.command(short_help="Measure the difference between two images.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object, for scripts.")
@click.option(
    "-o", "--output", type=FilledPath(), metavar="FILE",
    help="Write the signed difference A − B to this EXR.",
)
@click.argument("a", type=FilledPath(), metavar="A")
@click.argument("b", type=FilledPath(), metavar="B")
def diff(a: Path, b: Path, as_json: bool, output: Path | None) -> int:
    """Measure the difference of the image A from the reference B.

    Both can be EXR (R/G/B or mean, with or without variance; Y; one layer), PNG, JPEG, HDR, PFM, or
    NumPy arrays; all are compared as linear RGB. If B has a variance, it is subtracted from relMSE,
    MSE and rMSE, but not from σ/μ and FLIP. Relative errors are relative to B. "trimmed" omits the
    0.1 % of pixels with the largest errors.

    If both have a variance, z is the difference of the images' means in standard deviations:
    beyond ±4, one of them is probably biased. z assumes that pixels are independent. With a
    reconstruction filter wider than a pixel, they are not, and z is too large.
    """
    from ..images import image_files
    from ..startup import machine

    if output is not None:
        if output.suffix.lower() != ".exr":
            raise click.UsageError(f"{output}: the difference is written as .exr")
        image_files.check_target(output)
    image, reference = _read(a), _read(b)
    difference = _compare(image, reference)
    if output is not None:
        metadata = {"image": str(a), "reference": str(b), "versions": machine.versions()}
        image_files.write_exr(output, image.pixels - reference.pixels, "RGB", metadata)
    if as_json:
        click.echo(json.dumps(_record(image, reference, difference)))
        return 0
    _print(image, reference, difference)
    if output is not None:
        click.echo(str(output))
    return 0


@dataclass
class _Image:
    path: Path
    pixels: np.ndarray
    variance: np.ndarray | None
    channels: str
    remarks: list[str]

    @property
    def size(self) -> list[int]:
        return [self.pixels.shape[1], self.pixels.shape[0]]

    @property
    def means(self) -> list[float]:
        return self.pixels.mean(axis=(0, 1), dtype=float).tolist()


@dataclass
class _Difference:
    errors: Errors
    differing: int  # pixels
    largest: float
    largest_at: tuple[int, int, int]  # x, y, channel
    z: list[float | None] | None  # by channel

    @property
    def identical(self) -> bool:
        return self.differing == 0


def _read(path: Path) -> _Image:
    from ..images import metrics, reading
    from ..util.errors import InputError

    pixels, variance, metadata = reading.read_image(path)
    for name, values in (("", pixels), ("variance: ", variance)):
        if values is not None and (fault := metrics.describe_non_finite(values)):
            raise InputError(f"{path}: {name}{fault}")
    remarks = metadata.get("remarks", [])
    return _Image(path, pixels, variance, str(metadata["channels"]), remarks)


def _compare(image: _Image, reference: _Image) -> _Difference:
    import numpy as np

    from ..images import metrics
    from ..util.errors import InputError

    if image.size != reference.size:
        raise InputError(
            f"{image.path}: is {_times(image.size)}, but {reference.path} is "
            f"{_times(reference.size)}"
        )
    signed = image.pixels.astype(np.float64) - reference.pixels
    differing = int(signed.any(axis=2).sum())
    y, x, channel = np.unravel_index(np.argmax(np.abs(signed)), signed.shape)
    if differing == 0:
        # Zero even for black images. The reference's variance must not be subtracted from it
        errors = metrics.Errors(**dict.fromkeys(_FIGURES, 0.0))
    else:
        try:
            errors = metrics.errors(image.pixels, reference.pixels, reference.variance)
        except ValueError as error:  # the reference is black
            raise InputError(f"{reference.path}: {error}") from error
    return _Difference(
        errors=errors,
        differing=differing,
        largest=float(signed[y, x, channel]),
        largest_at=(int(x), int(y), int(channel)),
        z=_z_scores(image, reference, signed),
    )


def _z_scores(
    image: _Image, reference: _Image, signed: np.ndarray
) -> list[float | None] | None:
    """The difference of the means, divided by its standard deviation, per channel."""
    if image.variance is None or reference.variance is None:
        return None
    mean = signed.mean(axis=(0, 1))
    pixel_count = signed.shape[0] * signed.shape[1]
    variance = (image.variance.astype(float) + reference.variance).mean(axis=(0, 1)) / pixel_count
    return [float(m / math.sqrt(v)) if v > 0 else None for m, v in zip(mean, variance)]


def _record(image: _Image, reference: _Image, difference: _Difference) -> dict[str, object]:
    """The output of ``--json``. Unknown numbers are null because JSON has no NaN."""
    x, y, channel = difference.largest_at
    noise = _noise(reference, difference)
    return {
        "image": str(image.path),
        "reference": str(reference.path),
        "channels": {"image": image.channels, "reference": reference.channels},
        "remarks": {"image": image.remarks, "reference": reference.remarks},
        "size": image.size,
        "identical": difference.identical,
        **{name: _finite(getattr(difference.errors, name)) for name in _FIGURES},
        "reference_noise": noise,
        "mean": {
            "image": image.means,
            "reference": reference.means,
            "ratio": _ratios(image, reference),
        },
        "largest_difference": {
            "value": difference.largest, "x": x, "y": y, "channel": "RGB"[channel],
        },
        "differing_pixels": difference.differing,
        "z": difference.z,
    }


def _print(image: _Image, reference: _Image, difference: _Difference) -> None:
    from rich import box
    from rich.table import Table

    console = console_for_tables()

    def say(line: str) -> None:
        console.print(line, highlight=False, markup=False, soft_wrap=True)

    for name, item in (("A", image), ("B", reference)):
        taken = "" if item.channels in ("R/G/B", "Y", "array") else f" ({item.channels})"
        say(f"{name}  {item.path}{taken}")
        for remark in item.remarks:
            say(f"   warning: {remark}")
    say("")
    if difference.identical:
        say(f"The images are identical ({_times(image.size)}).")
        return

    figures = Table(box=box.SIMPLE_HEAD, show_edge=False)
    figures.add_column(f"A against B, {_times(image.size)}")
    figures.add_column("", justify="right")
    for name, heading in _FIGURES.items():
        figures.add_row(heading, _short(_finite(getattr(difference.errors, name))))
    console.print(figures)
    say("")

    channels = Table(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in ("", *"RGB"):
        channels.add_column(heading, justify="right" if heading else "left")
    channels.add_row("mean of A", *map(_short, image.means))
    channels.add_row("mean of B", *map(_short, reference.means))
    channels.add_row("ratio A / B", *map(_short, _ratios(image, reference)))
    if difference.z is not None:
        channels.add_row("z of A − B", *map(_short, difference.z))
    console.print(channels)
    say("")

    x, y, channel = difference.largest_at
    pair = (item.pixels[y, x, channel] for item in (image, reference))
    count, total = difference.differing, image.size[0] * image.size[1]
    say(f"{count} of {total} pixels differ, most at x={x}, y={y}: {'RGB'[channel]} is "
        f"{' instead of '.join(map(_short, pair))} ({difference.largest:+#.4g}).")
    noise = _noise(reference, difference)
    if noise is not None:
        say(f"The noise of B, relMSE {noise:.2g}, is subtracted (also from MSE and rMSE).")
    if math.isnan(difference.errors.flip):
        say("FLIP is not known: B has no positive pixel, or flip-evaluator is not installed.")


def _noise(reference: _Image, difference: _Difference) -> float | None:
    """The relMSE of the reference that was subtracted."""
    from ..images import metrics

    if difference.identical or reference.variance is None:
        return None
    return metrics.reference_noise(reference.pixels, reference.variance)


def _ratios(image: _Image, reference: _Image) -> list[float | None]:
    return [a / b if b != 0 else None for a, b in zip(image.means, reference.means)]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:#.4g}".rstrip(".")


def _times(size: list[int]) -> str:
    return f"{size[0]}x{size[1]}"
