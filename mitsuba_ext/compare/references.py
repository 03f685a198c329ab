"""What errors are measured against: images from files, or rendered once and kept.

A reference is the mean of independent batches, so that the variance of that mean is known too. On
disk it is an EXR with the channels ``mean.R/G/B`` and ``variance.R/G/B`` (variance of the mean);
an EXR with plain ``R/G/B`` is accepted where no variance is known.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..scenes import InputError, LoadedScene, make_integrator
from . import images, metrics
from .machine import versions

#: Batches of a rendered reference. Their spread gives the variance.
BATCH_COUNT = 16
MIN_BATCH_COUNT = 8

#: Seed of the first batch: far from those of the runs that are compared with it.
FIRST_SEED = 7_000_000

_RGB = ("R", "G", "B")


@dataclass
class Reference:
    """An image that is taken for the truth.

    Attributes:
        mean: Array (height, width, 3).
        variance: Variance of ``mean``, same shape; ``None`` if unknown.
        path: The file that holds it.
        metadata: What the file says about itself.
    """

    mean: np.ndarray
    variance: np.ndarray | None
    path: Path
    metadata: dict[str, object] = field(default_factory=dict)

    @property
    def noise(self) -> float | None:
        """relMSE of the reference itself; ``None`` if its variance is unknown."""
        return None if self.variance is None else metrics.reference_noise(self.mean, self.variance)

    @property
    def size(self) -> tuple[int, int]:
        return self.mean.shape[1], self.mean.shape[0]


def load_reference(path: str | Path, size: tuple[int, int] | None = None) -> Reference:
    """Reads a reference.

    Raises:
        InputError: The file is unreadable, lacks the channels, holds NaN or infinity, is black, or
            is not of the ``size`` that was asked for.
    """
    path = Path(path)
    channels, metadata = images.read_exr(path)
    mean = _stack(channels, "mean.")
    variance = _stack(channels, "variance.") if mean is not None else None
    if mean is None:
        mean = _stack(channels, "")
    if mean is None:
        found = ", ".join(channels)
        raise InputError(f"{path}: needs the channels mean.R/G/B or R/G/B, found {found}")
    reference = Reference(mean, variance, path, metadata)
    if size is not None and reference.size != size:
        raise InputError(
            f"{path}: is {_times(reference.size)}, but the scene renders {_times(size)} "
            f"(--size {_times(reference.size)}?)"
        )
    for name, values in (("mean", mean), ("variance", variance)):
        if values is not None and (fault := metrics.describe_non_finite(values)):
            raise InputError(f"{path}: {name}: {fault}")
    if not mean.any():
        raise InputError(f"{path}: is black")
    return reference


def render_reference(
    scene: LoadedScene,
    spp: int,
    folder: Path,
    progress: Callable[[float], None] | None = None,
) -> Reference:
    """Renders a reference with ``path`` at the depth of the scene, or takes it from ``folder`` if
    one is there that was rendered from the same files, size, parameters and versions.

    Args:
        scene: The scene.
        spp: Samples per pixel of all batches together; rounded up to a multiple of the batches.
        folder: Where references are kept. It must exist.
        progress: Called after each batch with the fraction that is done.
    """
    if spp < MIN_BATCH_COUNT:
        raise InputError(f"a reference needs at least {MIN_BATCH_COUNT} samples, found {spp}")
    batch_count = min(BATCH_COUNT, spp)
    batch_spp = -(-spp // batch_count)
    integrator, parameters = make_integrator("path", inherited=scene.depth)
    identity = {
        "scene": str(scene.path.resolve()),
        "content_hash": scene.content_hash,
        "size": _times(scene.size),
        "integrator": "path",
        "parameters": parameters,
        "spp": batch_spp * batch_count,
        "seeds": f"{FIRST_SEED}..{FIRST_SEED + batch_count - 1}, {batch_spp} spp each",
        "versions": {name: versions()[name] for name in ("mitsuba", "drjit", "variant")},
    }
    key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    name = f"{scene.path.parent.name}_{scene.path.stem}_{_times(scene.size)}_{spp}spp_{key[:12]}"
    path = folder / f"{name}.exr"
    cached = _cached(path, key)
    if cached is not None:
        return cached

    # Welford's update: no batch has to be kept
    mean = squares = 0.0
    for index in range(batch_count):
        rendered = integrator.render(
            scene.scene, sensor=0, seed=FIRST_SEED + index, spp=batch_spp, develop=True
        )
        batch = images.to_rgb(rendered).astype(np.float64)
        if fault := metrics.describe_non_finite(batch):
            raise InputError(f'{scene.path}: the reference of "path" has {fault}')
        deviation = batch - mean
        mean = mean + deviation / (index + 1)
        squares = squares + deviation * (batch - mean)
        if progress is not None:
            progress((index + 1) / batch_count)
    if not mean.any():
        raise InputError(f'{scene.path}: the reference of "path" is black')
    variance = squares / (batch_count - 1) / batch_count
    note = f"of the mean, from {batch_count} independent batches"
    _write(path, mean, variance, {**identity, "variance": note, "key": key})
    return load_reference(path, scene.size)


def _write(
    path: Path, mean: np.ndarray, variance: np.ndarray, metadata: Mapping[str, object]
) -> None:
    channels = [f"{name}.{color}" for name in ("mean", "variance") for color in _RGB]
    images.write_exr(path, np.concatenate([mean, variance], axis=2), channels, metadata)


def _cached(path: Path, key: str) -> Reference | None:
    if not path.is_file():
        return None
    try:
        reference = load_reference(path)
    except InputError:
        return None  # damaged: render it again
    return reference if reference.metadata.get("key") == key else None


def _stack(channels: Mapping[str, np.ndarray], prefix: str) -> np.ndarray | None:
    names = [prefix + color for color in _RGB]
    if not all(name in channels for name in names):
        return None
    return np.stack([channels[name] for name in names], axis=2)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
