"""Denoises images with Open Image Denoise [1], through the package ``mitsuba-oidn``.

The albedo and the shading normal of each pixel, if known, guide the denoiser. Each guide is
denoised first, separately. Denoised images are biased: compare techniques before denoising.

[1] Áfra. Intel Open Image Denoise. https://www.openimagedenoise.org
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from ..util.errors import InputError, InstallationError
from . import image_files, reading

if TYPE_CHECKING:
    import mitsuba as mi

#: The names of the guides, with which the names of their EXR layers end, and their channels.
_GUIDES = {"albedo": "RGB", "normal": "XYZ"}


def denoiser() -> ModuleType:
    """The module ``mitsuba_oidn``.

    Raises:
        InstallationError: The package is missing or cannot be loaded.
    """
    try:
        import mitsuba_oidn
    except (ImportError, OSError) as error:
        raise InstallationError(
            f"denoising needs the package mitsuba-oidn (Python 3.10 or later): pip install "
            f"'mitsuba_ext[denoise]' ({error})"
        ) from error
    return mitsuba_oidn


def remark(film: mi.Film) -> str | None:
    """A warning about the film of an image to be denoised; ``None`` if it is suitable.

    Raises:
        InputError: The film has no RGB image.
    """
    import mitsuba as mi

    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        raise InputError(f'the film "{film.class_name()}" has no RGB image to denoise')
    if film.rfilter().radius() > 0.5 + 1e-3:
        return (
            f'denoising works badly with the reconstruction filter "{film.rfilter().class_name()}" '
            f"of the film, which gives neighbours the same noise: use --filter box"
        )
    return None


def denoise(
    pixels: np.ndarray, albedo: np.ndarray | None = None, normal: np.ndarray | None = None,
    is_linear: bool = True,
) -> np.ndarray:  # fmt: skip
    """Denoises an image.

    Args:
        pixels: RGB, (height, width, 3).
        albedo: A guide; the same shape, in [0, 1].
        normal: A guide, used only with an albedo; the same shape, in [-1, 1].
        is_linear: ``False`` for images with 8 bits, in [0, 1].

    Returns:
        RGB, (height, width, 3). It may have NaN where ``pixels`` has NaN.

    Raises:
        InstallationError: See :func:`denoiser`.
    """
    oidn = denoiser()
    # Open Image Denoise accepts normals only with an albedo
    guides = {} if albedo is None else {"albedo": _without_noise(oidn, albedo, 1, 0)}
    if guides and normal is not None:
        guides["normal"] = _without_noise(oidn, normal, 2, -1)
    result = oidn.denoise(
        np.ascontiguousarray(pixels, dtype=np.float32), **guides, hdr=is_linear,
        clean_aux=bool(guides),
    )  # fmt: skip
    return np.array(result, dtype=np.float32)


def denoise_file(
    source: Path, targets: Iterable[Path], metadata: Mapping[str, object]
) -> list[str]:
    """Denoises an image file.

    Args:
        source: Any image that ``diff`` reads. An EXR may hold guides: layers whose names end with
            ``albedo`` (R, G, B) and ``normal`` (X, Y, Z).
        targets: Files to write; their extensions set the formats.
        metadata: Metadata for an EXR.

    Returns:
        The names of the guides used.

    Raises:
        InputError: The image cannot be read.
        InstallationError: See :func:`denoiser`.
    """
    oidn = denoiser()
    pixels, _, found = reading.read_image(source)
    channels = {}
    if source.suffix.lower() == ".exr":
        channels, _ = image_files.read_exr(source)
    guides = guides_of(channels)
    is_linear = source.suffix.lower() in (".exr", ".hdr", ".pfm", ".npy", ".npz")
    result = denoise(pixels, **guides, is_linear=is_linear)
    if not np.isfinite(result).all():
        raise InputError(f"{source}: cannot be denoised: the result has NaN or infinite pixels")
    about = {
        **metadata, "denoised": f"Open Image Denoise {oidn.oidn_version()}",
        "denoised_from": str(source), "guides": list(guides),
    }  # fmt: skip
    for target in targets:
        image_files.write_rgb(target, result, about)
    return list(guides)


def guides_of(channels: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The guides among the channels of an EXR, as arguments of :func:`denoise`."""
    guides = {name: _layer(channels, name) for name in _GUIDES}
    guides = {name: guide for name, guide in guides.items() if guide is not None}
    # Open Image Denoise accepts normals only with an albedo
    return guides if "albedo" in guides else {}


def _without_noise(
    oidn: ModuleType, guide: np.ndarray, scale: float, offset: float
) -> np.ndarray:
    """A denoised guide: with noise-free guides, the denoiser keeps more detail. The guide is
    ``scale`` · x + ``offset``, where x is in [0, 1], the range that the denoiser needs."""
    guide = np.asarray(guide, dtype=np.float32)
    result = np.array(oidn.denoise(np.ascontiguousarray((guide - offset) / scale), hdr=False))
    return np.ascontiguousarray(scale * result + offset, dtype=np.float32)


def _layer(channels: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """The only layer whose name ends with ``name``; ``None`` if there is none or several."""
    letters = _GUIDES[name]
    ends = {c.rpartition(".")[0] for c in channels if c.rpartition(".")[0].lower().endswith(name)}
    whole = [end for end in ends if all(f"{end}.{letter}" in channels for letter in letters)]
    if len(whole) != 1:
        return None
    return np.ascontiguousarray(
        np.stack([channels[f"{whole[0]}.{letter}"] for letter in letters], axis=2)
    )
