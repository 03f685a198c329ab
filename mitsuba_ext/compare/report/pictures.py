"""The images of a scene for the screen: all with one exposure, and error maps in one colour scale.

Every image is an 8-bit PNG with the size of the film, as a ``data:`` URI. Scaling or lossy
compression could be mistaken for errors of the integrator.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...images import metrics, reading
from ...util.errors import InputError
from .records import Record, pictured_runs

#: The exposure maps this percentile of the reference's luminance …
EXPOSURE_PERCENTILE = 95
#: … to this fraction of white (linear).
EXPOSURE_TARGET = 0.8

#: matplotlib's name of the colour map: perceptually uniform, and black for no error.
COLOR_MAP = "inferno"

#: The maximum number of decades that the colour scale of the errors covers.
MAX_DECADES = 6

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear sRGB


@dataclass
class Picture:
    """An image of the viewer.

    Attributes:
        name: ``reference``, or the label of an integrator.
        integrator: The integrator's record; ``None`` for the reference.
        run: The run that rendered it; ``None`` for the reference.
        pixels: 8-bit sRGB, (height, width, 3).
        image: ``pixels`` as a URI.
        error: Mean relative squared error of every pixel over the runs, (height, width);
            ``None`` without a reference.
        error_map: ``error`` in colours, as a URI; empty if ``error`` is ``None``.
    """

    name: str
    integrator: Record | None
    run: Record | None
    pixels: np.ndarray
    image: str
    error: np.ndarray | None = None
    error_map: str = ""


@dataclass
class Pictures:
    """The images of a scene.

    Attributes:
        pictures: The reference, if there is one, then the integrators in their order.
        size: Width and height in pixels.
        exposure: The factor by which the linear values were multiplied.
        limits: Errors at the ends of the colour scale; ``None`` without error maps.
        faults: Sentences about the files that could not be read.
    """

    pictures: list[Picture] = field(default_factory=list)
    size: tuple[int, int] = (1, 1)
    exposure: float = 1.0
    limits: tuple[float, float] | None = None
    faults: list[str] = field(default_factory=list)


def load_pictures(scene: Record, level: float | None, folder: Path) -> Pictures:
    """Reads the images of the scene's runs at ``level``; the first round's images are shown."""
    result = Pictures()
    reference = None
    if scene["reference"]:
        try:
            reference = _read(folder / scene["reference"]["path"])
        except InputError as error:
            result.faults.append(f"the reference is missing here: {error}")
    shape = None if reference is None else reference.shape

    # One image per integrator stays in memory until the exposure is known, which comes from the
    # reference or, without one, from the first image. Errors are summed run by run.
    waiting: list[tuple[Record, Record, np.ndarray, np.ndarray | None]] = []
    for integrator in scene["integrators"]:
        first, total, count = None, None, 0
        for run in pictured_runs(integrator, level):
            try:
                pixels = _read(folder / run["image"], shape)
            except InputError as error:
                result.faults.append(f"{integrator['label']}, seed {run['seed']}: {error}")
                continue
            shape = pixels.shape
            first = first or (run, pixels)
            error = None if reference is None else relative_error(pixels, reference)
            if error is not None:
                total = error if total is None else total + error
                count += 1
        if first is not None:
            mean = None if total is None else total / count
            waiting.append((integrator, *first, mean))
    if shape is None:
        return result

    result.size = (shape[1], shape[0])
    result.exposure = exposure(waiting[0][2] if reference is None else reference)
    if reference is not None:
        pixels = tone_map(reference, result.exposure)
        result.pictures.append(Picture("reference", None, None, pixels, png(pixels)))
    result.limits = color_limits([error for *_, error in waiting if error is not None])
    for integrator, run, linear, error in waiting:
        pixels = tone_map(linear, result.exposure)
        picture = Picture(integrator["label"], integrator, run, pixels, png(pixels), error)
        if error is not None and result.limits is not None:
            picture.error_map = png(color_indices(error, result.limits), color_table())
        result.pictures.append(picture)
    return result


def exposure(pixels: np.ndarray) -> float:
    """The factor that brings the brighter parts of an image near white; 1 for a black image."""
    luminance = pixels @ np.array(_LUMINANCE)
    for bright in (np.percentile(luminance, EXPOSURE_PERCENTILE), luminance.max()):
        if bright > 0:  # the percentile is 0 if less than 5 % of the pixels are not black
            return float(EXPOSURE_TARGET / bright)
    return 1.0


def tone_map(pixels: np.ndarray, factor: float) -> np.ndarray:
    """Linear values as 8-bit sRGB; values above 1 are clipped."""
    linear = np.clip(pixels * factor, 0, 1)
    encoded = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.round(encoded * 255).astype(np.uint8)


def relative_error(pixels: np.ndarray, reference: np.ndarray) -> np.ndarray | None:
    """(I−R)² / (R² + ε) of every pixel, averaged over its channels; ``None`` for a black reference.

    The reference's variance is not subtracted: many differences would be negative.
    """
    floor = metrics.RELATIVE_FLOOR * reference.mean() ** 2
    if floor == 0:
        return None
    return ((pixels - reference) ** 2 / (reference**2 + floor)).mean(axis=2)


def color_limits(errors: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """The limits of a shared logarithmic scale for several error maps. They exclude the smallest 2
    % and largest 0.2 % of pixels, and are rounded outwards to 1, 2 or 5 times a power of ten."""
    if not errors:
        return None
    values = np.concatenate([error[error > 0] for error in errors])
    if values.size == 0:
        return 1e-3, 1.0  # all images equal the reference
    low, high = np.percentile(values, (2, 99.8))
    low = max(low, high * 10.0**-MAX_DECADES)
    return _rounded(low, up=False), _rounded(high, up=True)


def color_indices(error: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Indices into :func:`color_table`, by the logarithm of the error."""
    low, high = np.log10(limits)
    # high > low: both are rounded outwards, to different numbers. The maximum avoids log10(0)
    share = (np.log10(np.maximum(error, limits[0])) - low) / (high - low)
    return np.round(np.clip(share, 0, 1) * 255).astype(np.uint8)


def color_table() -> np.ndarray:
    """256 colours, 8-bit sRGB."""
    import matplotlib

    return np.round(matplotlib.colormaps[COLOR_MAP](np.arange(256))[:, :3] * 255).astype(np.uint8)


def png(pixels: np.ndarray, palette: np.ndarray | None = None) -> str:
    """A PNG as a ``data:`` URI; with a palette, ``pixels`` are indices into it."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(pixels))
    if palette is not None:
        image.putpalette(palette.tobytes())
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _read(path: Path, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Reads an image (the mean of a reference with a variance) in double precision."""
    pixels = reading.read_image(path)[0].astype(np.float64)
    if shape is not None and pixels.shape != shape:
        sizes = [f"{width}x{height}" for height, width, _ in (pixels.shape, shape)]
        raise InputError(f"{path}: is {sizes[0]}, the other images are {sizes[1]}")
    if fault := metrics.describe_non_finite(pixels):
        raise InputError(f"{path}: {fault}")
    return pixels


def _rounded(value: float, up: bool) -> float:
    """The next 1, 2 or 5 times a power of ten, ``up`` or down."""
    power = 10.0 ** np.floor(np.log10(value))
    steps = [power * step for step in (0.5, 1, 2, 5, 10, 20)]
    if up:
        return float(next(step for step in steps if step > value))
    return float(next(step for step in reversed(steps) if step <= value))
