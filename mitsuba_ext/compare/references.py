"""Reference images for measuring errors: read from files, or rendered once and stored.

A rendered reference is the mean of independent batches, so the variance of this mean is known. On
disk, it is an EXR with the channels ``mean.R/G/B`` and ``variance.R/G/B`` (variance of the mean).
An EXR with plain ``R/G/B`` is also accepted, with or without ``variance.R/G/B`` (which the
integrator ``variance`` writes). Stored references hold a checksum: a reference that is damaged, or
was written by an earlier version without a checksum, is rendered anew.
"""

from __future__ import annotations

import glob
import hashlib
import json
import math
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..images import image_files, metrics
from ..inputs.scene_remarks import scene_remarks
from ..inputs.scenes import LoadedScene, scene_name
from ..inputs.specifications import NamedIntegrator, Specification, make_named
from ..rendering.batches import Batches, batch_seeds, each_batch
from ..startup.machine import versions
from ..util.errors import InputError, one_line
from ..util.files import replacing
from ..util.marks import mark_of, marked
from .reference_choice import choose_integrator

if TYPE_CHECKING:
    from ..long_renders.divided_references import ReferenceWorkers

#: The number of batches of a rendered reference. Their variance gives the reference's variance.
BATCH_COUNT = 16
MIN_BATCH_COUNT = 8

#: The seed of references, from which ``batch_seeds`` derives the seeds of the batches.
FIRST_SEED = 7_000_000

#: The samples per pixel of the pilot from which the noise of a longer reference is extrapolated.
_PILOT_SPP = 64

_RGB = ("R", "G", "B")


@dataclass
class Reference:
    """An image used as the exact solution.

    Attributes:
        mean: The image, array (height, width, 3).
        variance: Variance of ``mean``, same shape; ``None`` if unknown.
        path: The file that holds it.
        metadata: The metadata of that file.
        fault: How the file differs from what we wrote (:func:`.image_files.fault_of`), or empty.
    """

    mean: np.ndarray
    variance: np.ndarray | None
    path: Path
    metadata: dict[str, object] = field(default_factory=dict)
    fault: str = ""

    @property
    def noise(self) -> float | None:
        """The relMSE of the reference itself; ``None`` if its variance is unknown."""
        return None if self.variance is None else metrics.reference_noise(self.mean, self.variance)

    @property
    def spp(self) -> int | None:
        """The number of samples per pixel; ``None`` if the metadata does not give it."""
        spp = self.metadata.get("spp")
        return int(spp) if isinstance(spp, (int, float)) else None

    @property
    def size(self) -> tuple[int, int]:
        return self.mean.shape[1], self.mean.shape[0]


def load_reference(path: str | Path, size: tuple[int, int] | None = None) -> Reference:
    """Reads a reference.

    Raises:
        InputError: The file is unreadable, lacks the channels, holds NaN or infinity, is black, or
            does not have the requested ``size``.
    """
    path = Path(path)
    channels, metadata = image_files.read_exr(path)
    mean = _stack(channels, "mean.")
    variance = _stack(channels, "variance.")
    if mean is None:
        mean = _stack(channels, "")
    if mean is None:
        found = ", ".join(channels)
        raise InputError(f"{path}: needs the channels mean.R/G/B or R/G/B, found {found}")
    fault = image_files.fault_of(channels, metadata)
    reference = Reference(mean, variance, path, metadata, fault)
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
    integrator: Specification | None = None,
    progress: Callable[[float], None] | None = None,
    enough: int | None = None,
    workers: ReferenceWorkers | None = None,
    warn: Callable[[str], None] = lambda remark: None,
) -> Reference:
    """Renders a reference with the settings of the scene's integrator, or loads it from ``folder``.

    A stored reference is used if it was rendered from the same files, at the same size, by the same
    integrator and versions, with enough samples. An interrupted one is continued.

    Args:
        scene: The scene.
        spp: Samples per pixel of all batches together; rounded up to a multiple of the number of
            batches.
        folder: The existing folder in which references are stored.
        integrator: The unbiased integrator that renders it. By default,
            :func:`.reference_choice.choose_integrator` chooses it.
        progress: A function that is called after each batch with the fraction done.
        enough: The number of samples that a stored reference must have to be used. By default,
            ``spp``.
        workers: The workers that render it. By default, this process.
        warn: A function that is called with a sentence about each damaged stored file.

    Raises:
        InputError: ``spp`` is below 8, the integrator fails, or the image is black or holds NaN or
            infinity.
    """
    if spp < MIN_BATCH_COUNT:
        raise InputError(f"a reference needs at least {MIN_BATCH_COUNT} samples, found {spp}")
    integrator = integrator or choose_integrator(scene).integrator
    named = make_named(integrator, scene.settings)
    cached, faults = _best_cached(folder, _identity(scene, named))
    if cached is not None and (cached.spp or 0) >= min(spp, enough or spp):
        return cached
    for path, fault in faults.items():
        warn(f"{path}: {fault}: the reference is rendered anew")
    try:
        return _render(scene, spp, folder, named, integrator, progress, workers, warn)
    except InputError as error:
        raise InputError(f'{scene.source}: the reference of "{named.label}" {error}') from error
    except Exception as error:  # an integrator may raise anything
        message = f'the reference of "{named.label}" failed: {one_line(error)}'
        raise InputError(f"{scene.source}: {message}") from error


def stored_reference(
    scene: LoadedScene, folder: Path, integrator: Specification
) -> Reference | None:
    """The stored reference of the scene with the most samples, if ``folder`` has one."""
    return _best_cached(folder, _identity(scene, make_named(integrator, scene.settings)))[0]


def _render(
    scene: LoadedScene,
    spp: int,
    folder: Path,
    named: NamedIntegrator,
    specification: Specification,
    progress: Callable[[float], None] | None,
    workers: ReferenceWorkers | None,
    warn: Callable[[str], None],
) -> Reference:
    batch_count = min(BATCH_COUNT, spp)
    batch_spp = -(-spp // batch_count)
    identity = _identity(scene, named)
    path = folder / f"{identity['stem']}_{batch_spp * batch_count}spp.exr"
    partial = path.with_suffix(".partial.npz")
    batches = unfinished = _unfinished(partial)
    if batches is None and partial.exists():
        warn(f"{partial}: it is damaged: the reference begins anew")
    if workers is None:
        seeds = batch_seeds(FIRST_SEED, batch_count)[unfinished.count if unfinished else 0 :]
        rendered = each_batch(named.integrator, scene.scene, 0, batch_spp, seeds, unfinished)
    else:
        rendered = workers.batches(
            scene, specification, FIRST_SEED, batch_count, batch_spp, unfinished
        )
    start = time.perf_counter()
    with marked(mark_of(folder, f"{named.label}_{scene.content_hash}")):
        for batches in rendered:
            rgb = image_files.to_rgb(batches.mean, batches.channels)
            if fault := metrics.describe_non_finite(rgb):
                raise InputError(f"has {fault}")
            with replacing(partial) as temporary:
                batches.save(temporary)
            if progress is not None:
                progress(batches.count / batch_count)
    mean = image_files.to_rgb(batches.mean, batches.channels)
    variance = image_files.to_rgb(batches.variance, batches.channels)
    if not mean.any():
        raise InputError("is black")
    remarks = scene_remarks(scene, named.integrator, named.label)
    metadata = {
        **identity,
        **({image_files.REMARKS: remarks} if remarks else {}),
        "spp": batches.spp,
        "seeds": f"{batch_count} batches of {batches.spp // batch_count} spp",
        "variance": f"of the mean, from {batch_count} independent batches",
        "seconds": time.perf_counter() - start,
    }
    channels = [f"{name}.{color}" for name in ("mean", "variance") for color in _RGB]
    image_files.write_exr(path, np.concatenate([mean, variance], axis=2), channels, metadata)
    partial.unlink(missing_ok=True)
    return load_reference(path, scene.size)


def _identity(scene: LoadedScene, named: NamedIntegrator) -> dict[str, object]:
    """Everything on which a reference depends, its hash as ``key``, and a file name as ``stem``."""
    identity = {
        "scene": scene.source,
        "content_hash": scene.content_hash,
        "size": _times(scene.size),
        "integrator": named.label,
        "parameters": named.parameters,
        "versions": {name: versions()[name] for name in ("mitsuba", "drjit", "variant")},
    }
    text = json.dumps({**identity, "made of": named.identity}, sort_keys=True, default=str)
    key = hashlib.sha256(text.encode()).hexdigest()
    stem = f"{scene_name(scene.path)}_{_times(scene.size)}_{key[:12]}"
    return {**identity, "key": key, "stem": stem}


def samples_for_noise(scene: LoadedScene, noise: float, integrator: Specification) -> int:
    """The samples per pixel (a power of two) with which a reference has at most the relMSE
    ``noise``, extrapolated from a short pilot reference.

    Raises:
        InputError: The pilot cannot be rendered, or is black.
    """
    with tempfile.TemporaryDirectory() as folder:
        pilot = render_reference(scene, _PILOT_SPP, Path(folder), integrator)
    needed = _PILOT_SPP * (pilot.noise or 0) / noise
    return 1 << max(0, math.ceil(math.log2(max(needed, BATCH_COUNT))))


def _unfinished(path: Path) -> Batches | None:
    """The stored batches of an interrupted reference; ``None`` if they are missing or damaged."""
    try:
        return Batches.load(path)
    except Exception:  # zipfile, zlib and NumPy raise many kinds
        return None


def _best_cached(
    folder: Path, identity: Mapping[str, object]
) -> tuple[Reference | None, dict[Path, str]]:
    """The stored reference with the most samples, and the faults of unusable ones."""
    found, faults = [], {}
    for path in folder.glob(f"{glob.escape(str(identity['stem']))}_*spp.exr"):
        try:
            reference = load_reference(path)
        except InputError as error:
            faults[path] = str(error).removeprefix(f"{path}: ")
            continue
        if reference.fault:
            faults[path] = reference.fault
        elif reference.metadata.get("key") == identity["key"]:
            found.append(reference)
    return max(found, key=lambda reference: reference.spp or 0, default=None), faults


def _stack(channels: Mapping[str, np.ndarray], prefix: str) -> np.ndarray | None:
    names = [prefix + color for color in _RGB]
    if not all(name in channels for name in names):
        return None
    return np.stack([channels[name] for name in names], axis=2)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
