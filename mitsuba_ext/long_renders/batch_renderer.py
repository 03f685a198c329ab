"""Renders one batch after the other, in any process."""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..chosen import LastScene
from ..compare.machine import versions
from ..errors import InputError
from ..rendering.batches import batch_seeds, each_batch, sample_count
from ..rendering.camera import film_extent
from ..rendering.film_sums import FilmSums
from ..rendering.seed_passes import can_render, is_independent, pass_length
from ..rendering.totals import RenderTotals, forget_memory_peak
from ..scenes import one_line
from .bundle import Bundle
from .state import Batch, BatchResult

#: About how many samples a batch of ours has: each traces its kernels anew, and begins its chains.
_SAMPLES = {dr.JitBackend.LLVM: 1 << 22, dr.JitBackend.CUDA: 1 << 25}

#: Samples per pixel of a batch of ours, at least, and of one whose samples are stratified.
_SPP, _STRUCTURED_SPP = 16, 64

#: Samples per pixel of the batch that the others learn from, if there are so many.
_LEARNING_SPP = 128


@dataclass(frozen=True)
class RenderRequest:
    """What to render. It can be sent to other processes, and to other machines.

    Attributes:
        scene: The file.
        size, definitions: Of the image, and values of the file's ``$name`` parameters.
        specification: The integrator; ``None`` for the scene's.
        sensor: Its number.
        seed: Of the random numbers.
        variant, plugins: Mitsuba's variant, and modules that register other plugins.
        threads: Of a process; 0 for as many as there are cores.
        values: Of the loaded scene, as :func:`~mitsuba_ext.scene_values.as_text` makes them;
            ``None`` if no frame has any.
        description: What the image depends on, as JSON: a process that would render another image
            refuses. Empty for what each process finds.
    """

    scene: str
    size: tuple[int, int] | None = None
    definitions: tuple[tuple[str, str], ...] = ()
    specification: str | None = None
    sensor: int = 0
    seed: int = 0
    variant: str = "llvm_ad_rgb"
    plugins: tuple[str, ...] = ()
    threads: int = 0
    values: str | None = None
    description: str = ""


class BatchRenderer:
    """Renders the batches of a request.

    Parameters:
        request: What to render; its variant is the active one.
        bundle: The scene's files; ``None`` for those at their paths.
        scenes: Keeps the scene.

    Attributes:
        chosen: The scene, the integrator and the sensor.
        sensor: The sensor.
        learns: Does the integrator learn something that can be kept?

    Raises:
        InputError: The scene, the integrator or the sensor cannot be used.
    """

    def __init__(
        self, request: RenderRequest, bundle: Bundle | None = None, scenes: LastScene | None = None
    ) -> None:
        if not dr.is_jit_v(mi.Float):
            raise InputError(
                f'batches need a variant such as "llvm_ad_rgb", and not "{mi.variant()}"'
            )
        self._request = request
        with bundle.unpacked() if bundle else contextlib.nullcontext() as moved:
            scene, specification = request.scene, request.specification
            if moved:
                scene, specification = moved(scene), specification and moved(specification)
            self.chosen = (scenes or LastScene()).choose(
                Path(scene), request.size, dict(request.definitions), specification,
                request.sensor, request.values, moved,
            )  # fmt: skip
        self.chosen.loaded.path = Path(request.scene)
        self.sensor = self.chosen.sensor
        integrator = self.chosen.named.integrator
        # Its own file, if it has one, holds for all batches already
        self.learns = bool(
            getattr(integrator, "can_learn", False)
            and not integrator.save_learned
            and not integrator.load_learned
        )

    def description(self) -> dict[str, Any]:
        """What the image depends on, but for the number of samples."""
        request, film = self._request, self.sensor.film()
        loaded, named = self.chosen.loaded, self.chosen.named
        return {
            "scene": loaded.source,
            "scene files hash": loaded.content_hash,
            **({"values of the scene": request.values} if request.values else {}),
            "size": "x".join(map(str, film.crop_size())),
            "integrator": named.name,
            "parameters": named.parameters,
            "integrator hash": named.identity,
            "sensor": request.sensor,
            "seed": request.seed,
            "versions": {k: v for k, v in versions().items() if k not in ("numpy", "python")},
        }

    def length(self, spp: int, teaches: bool) -> int:
        """The samples per pixel of the next batch, of ``spp`` that are left. It does not depend on
        the speed, so that the same command gives the same image.

        Args:
            teaches: Do the batches after it use what it learns?
        """
        if can_render(self.chosen.named.integrator):
            return min(pass_length(self.sensor), spp)
        limit = _SAMPLES[dr.backend_v(mi.Float)] // math.prod(film_extent(self.sensor.film()))
        limit = max(limit, _SPP if is_independent(self.sensor) else _STRUCTURED_SPP)
        if teaches:
            limit = max(limit, _LEARNING_SPP)
        return min(sample_count(self.sensor, 1 << (limit.bit_length() - 1)), spp)

    def render(self, batch: Batch, learned: bytes | None = None) -> BatchResult:
        """
        Args:
            learned: What an earlier batch has learned; empty if there was nothing to learn;
                ``None`` if this batch is the one that learns it.

        Raises:
            InputError: The integrator cannot render this scene.
            KeyboardInterrupt: The batch was interrupted: it is lost.
        """
        if not self.learns:
            return self._rendered(batch)
        integrator = self.chosen.named.integrator
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "learned.npz"
            if learned:
                file.write_bytes(learned)
                integrator.load_learned = str(file)
            elif learned is None:
                integrator.save_learned = str(file)
            try:
                result = self._rendered(batch)
            finally:
                integrator.load_learned = integrator.save_learned = ""
            if learned is None:
                result = result._replace(learned=file.read_bytes() if file.exists() else b"")
            return result

    def _rendered(self, batch: Batch) -> BatchResult:
        loaded, named, film = self.chosen.loaded, self.chosen.named, self.sensor.film()
        integrator = named.integrator
        seed = batch_seeds(batch.seed, 1, batch.index)[0]
        forget_memory_peak()
        begin = time.perf_counter()
        try:
            batches = each_batch(integrator, loaded.scene, self.sensor, batch.spp, [seed])
            images = next(batches)
        except (ValueError, TypeError, RuntimeError) as error:
            message = f'{loaded.source}: "{named.name}": {one_line(error)}'
            raise InputError(message) from error
        totals = RenderTotals.of(integrator, film, images.spp, time.perf_counter() - begin)
        sums = FilmSums()
        sums.add(film, images.spp)
        return BatchResult(
            batch._replace(spp=images.spp), sums.contents.astype(np.float32), sums.has_weights,
            images.mean.astype(np.float32), images.channels, images.image_channel_count,
            tuple(integrator.aov_names()), totals,
        )  # fmt: skip
