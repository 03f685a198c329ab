"""Reads images from any source as linear RGB: our own renders and references, images of other
renderers, photographs, arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..util.errors import InputError
from . import image_files

Channels = Mapping[str, np.ndarray]


def read_image(path: str | Path) -> tuple[np.ndarray, np.ndarray | None, dict[str, object]]:
    """Reads an image as linear RGB.

    ====================  ======================================================================
    ``.npy``, ``.npz``    Linear floating point, (height, width) or (height, width, 1, 3 or 4). An
                          ``.npz`` holds one array, or ``mean`` and perhaps ``variance``.
    EXR                   ``mean.R/G/B`` (a reference), else ``R/G/B``, both with ``variance.R/G/B``
                          if present (the integrator ``variance`` adds it), else ``Y``, else the
                          only layer that has ``R/G/B`` (Blender's ``Combined`` if there are
                          several). Of several parts, only the first is read.
    PNG, JPEG, BMP, TGA   8 or 16 bits per channel, sRGB: made linear, 1 is white.
    HDR (RGBE), PFM       Linear.
    ====================  ======================================================================

    Grey is repeated, alpha is dropped. The format is recognised by the content of the file, not by
    its extension, except for NumPy's.

    Returns:
        The image (height, width, 3) and its variance of the same shape (``None`` if unknown), in
        single precision, and the metadata of the file. The entry ``channels`` of the metadata names
        the channels that were read, for example ``"ViewLayer.Combined.R/G/B"``. The entry
        ``remarks``, if present, holds the result of :func:`.image_files.remarks_of`.

    Raises:
        InputError: The file cannot be read, or does not contain exactly one image.
    """
    path = Path(path)
    if path.suffix.lower() in (".npy", ".npz"):
        return _read_arrays(path)
    try:
        channels, metadata = _read_channels(path)
    except MemoryError as error:  # possibly from the size in a damaged header
        raise InputError(f"{path}: unreadable (its size needs too much memory)") from error
    for pick in (_reference, _plain, _grey, _layer):
        found = pick(channels)
        if found is not None:
            pixels, variance, name = found
            about = {**metadata, "channels": name}
            about["remarks"] = image_files.remarks_of(channels, metadata)
            return pixels, variance, about
    layers = _layers(channels)
    more = " (only the first part of the file is read)" if "chunkCount" in metadata else ""
    raise InputError(
        f"{path}: has no R/G/B, and several layers that do: {', '.join(layers)}"
        if layers
        else f"{path}: needs the channels R/G/B or Y, found {', '.join(channels)}{more}"
    )


def srgb_to_linear(values: np.ndarray) -> np.ndarray:
    """The inverse of the sRGB transfer function (IEC 61966-2-1), for values from 0 to 1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


# ---- bitmaps ----


def _read_channels(path: Path) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    bitmap, names, metadata = image_files.open_bitmap(path)
    values = np.array(bitmap)
    if values.dtype in (np.uint8, np.uint16):
        values = values / np.float64(np.iinfo(values.dtype).max)
        if bitmap.srgb_gamma():
            values = srgb_to_linear(values)
    elif not np.issubdtype(values.dtype, np.floating):
        raise InputError(f"{path}: holds {values.dtype} values, which are not an image")
    values = values.reshape(*values.shape[:2], -1).astype(np.float32)
    return {name: values[:, :, index] for index, name in enumerate(names)}, metadata


def _reference(channels: Channels) -> tuple[np.ndarray, np.ndarray | None, str] | None:
    mean = _stack(channels, "mean.")
    return None if mean is None else (mean, _stack(channels, "variance."), "mean.R/G/B")


def _plain(channels: Channels) -> tuple[np.ndarray, np.ndarray | None, str] | None:
    pixels = _stack(channels, "")
    return None if pixels is None else (pixels, _stack(channels, "variance."), "R/G/B")


def _grey(channels: Channels) -> tuple[np.ndarray, None, str] | None:
    if "Y" not in channels:
        return None
    return np.repeat(channels["Y"][:, :, None], 3, axis=2), None, "Y"


def _layer(channels: Channels) -> tuple[np.ndarray, None, str] | None:
    layers = _layers(channels)
    if len(layers) > 1:
        layers = [name for name in layers if name.split(".")[-1] == "Combined"]
    if len(layers) != 1:
        return None
    return _stack(channels, f"{layers[0]}."), None, f"{layers[0]}.R/G/B"


def _layers(channels: Channels) -> list[str]:
    names = [name[: -len(".R")] for name in channels if name.endswith(".R")]
    return [name for name in names if all(f"{name}.{color}" in channels for color in "GB")]


def _stack(channels: Channels, prefix: str) -> np.ndarray | None:
    names = [prefix + color for color in "RGB"]
    if not all(name in channels for name in names):
        return None
    return np.stack([channels[name] for name in names], axis=2)


# ---- arrays ----


def _read_arrays(path: Path) -> tuple[np.ndarray, np.ndarray | None, dict[str, object]]:
    image_files.check_file(path)
    try:
        content = np.load(path, allow_pickle=False)
        # np.load reads an array of an .npz only when it is accessed: dict() reads all
        arrays = {"": content} if isinstance(content, np.ndarray) else dict(content)
    except Exception as error:  # a damaged file: zipfile, zlib and numpy raise many kinds of errors
        reason = str(error).partition("\n")[0].partition(". ")[0] or type(error).__name__
        raise InputError(f"{path}: unreadable ({reason})") from error
    name = "mean" if "mean" in arrays else next(iter(arrays), "")
    if name != "mean" and len(arrays) != 1:
        found = ", ".join(arrays) or "nothing"
        raise InputError(f"{path}: needs one array, or mean and variance, found {found}")
    pixels = _as_rgb(path, name, arrays[name])
    variance = _as_rgb(path, "variance", arrays["variance"]) if "variance" in arrays else None
    if variance is not None and (name != "mean" or variance.shape != pixels.shape):
        raise InputError(f"{path}: mean and variance do not fit together")
    return pixels, variance, {"channels": name or "array"}


def _as_rgb(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    label = f"{path}: {name}: " if name else f"{path}: "
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"{label}holds {array.dtype} values, expected linear floating point")
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or array.size == 0:
        shape = "x".join(map(str, array.shape))
        raise InputError(f"{label}an array {shape} is not an image (height, width[, 1, 3 or 4])")
    with np.errstate(over="ignore"):  # overflow becomes infinity, which the metrics report
        array = array.astype(np.float32)
    return np.repeat(array, 3, axis=2) if array.shape[2] == 1 else array[:, :, :3]
