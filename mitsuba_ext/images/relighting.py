"""Mixes the lights of an image after the render."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..util.errors import InputError, did_you_mean
from . import denoising, image_files


def relight(
    channels: Mapping[str, np.ndarray], factors: Mapping[str, float | Sequence[float]]
) -> np.ndarray:
    """Multiplies the light of some channels of an image: image + Σ (factor − 1) · channel. All
    other light stays as it is.

    Args:
        channels: The channels of the image, (height, width) each, by name: ``R``, ``G``, ``B``, and
            ``NAME.R``, ``NAME.G``, ``NAME.B`` of each light path expression or light group.
        factors: A factor, or three for red, green and blue, by the name of the channel. The last
            part of a name is enough: ``key`` for ``groups.key``.

    Returns:
        RGB, (height, width, 3).

    Raises:
        InputError: The image has no colours, no such channel or several, or a factor is not a
            number.
    """
    image = _colours(channels, "")
    if image is None:
        raise InputError("the image has no channels R, G and B")
    mixed = np.array(image, np.float32)
    for name, factor in factors.items():
        values = np.asarray(factor, np.float32)
        if values.shape not in ((), (3,)) or not np.isfinite(values).all():
            raise InputError(f"{name}: a factor must be one number or three, found {factor}")
        mixed += (values - 1) * _colours(channels, f"{_layer(channels, name)}.")
    return mixed


def relight_file(
    source: str | Path,
    factors: Mapping[str, float | Sequence[float]],
    targets: Iterable[str | Path] = (),
    denoise: bool = False,
) -> np.ndarray:
    """:func:`relight` for an EXR file.

    Args:
        source: The EXR.
        factors: See :func:`relight`.
        targets: Files to which the mixed image is written: .exr, .png, .jpg, .hdr or .pfm.
        denoise: Whether to denoise the mixed image, with the guides that the file holds
            (:func:`mitsuba_ext.images.denoising.denoise_file`).

    Returns:
        RGB, (height, width, 3).

    Raises:
        InputError: A file cannot be read or written, or as for :func:`relight`.
        InstallationError: The denoiser is not installed.
    """
    source = Path(source)
    channels, _metadata = image_files.read_exr(source)
    try:
        mixed = relight(channels, factors)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    if denoise:
        mixed = denoising.denoise(mixed, **denoising.guides_of(channels))
    about = {
        "relit_from": str(source),
        "factors": " ".join(f"{name}={factor}" for name, factor in factors.items()),
    }
    for target in targets:
        image_files.write_rgb(Path(target), mixed, about)
    return mixed


def layers(channels: Iterable[str]) -> list[str]:
    """The names of the layers that have colours, in alphabetical order."""
    names = set(channels)
    ends = {name[:-2] for name in names if name.endswith(".R")}
    return sorted(end for end in ends if {f"{end}.G", f"{end}.B"} <= names)


def _layer(channels: Iterable[str], name: str) -> str:
    known = layers(channels)
    found = [layer for layer in known if layer == name]
    found = found or [layer for layer in known if layer.endswith(f".{name}")]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(f'several layers are called "{name}": {", ".join(found)}')
    short = [layer.rpartition(".")[2] for layer in known]
    hint = did_you_mean(name, [*known, *short])
    listed = f"; it has {', '.join(known)}" if known else ' (render it with aovs="g:light_groups")'
    raise InputError(f'it has no layer "{name}"{hint or listed}')


def _colours(channels: Mapping[str, np.ndarray], prefix: str) -> np.ndarray | None:
    names = [prefix + colour for colour in "RGB"]
    if not all(name in channels for name in names):
        return None
    return np.stack([channels[name] for name in names], axis=2)
