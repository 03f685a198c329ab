"""Renders one batch after the other, in any process."""

from __future__ import annotations

import functools
import json
import math
import os
import platform
import threading
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
from ..variants import select_variant
from .folder import difference
from .state import Batch, BatchResult

#: About how many samples a batch of ours has: each traces its kernels anew, and begins its chains.
_SAMPLES = {dr.JitBackend.LLVM: 1 << 22, dr.JitBackend.CUDA: 1 << 25}

#: Samples per pixel of a batch of ours, at least, and of one whose samples are stratified.
_SPP, _STRUCTURED_SPP = 16, 64

#: Samples per pixel of the batch that the others learn from, if there are so many.
_LEARNING_SPP = 128


@dataclass(frozen=True)
class RenderRequest:
    """What to render. It can be sent to other processes, and to other machines that see its files.

    Attributes:
        scene: The file.
        size, definitions: Of the image, and values of the file's ``$name`` parameters.
        specification: The integrator; ``None`` for the scene's.
        sensor: Its number.
        seed: Of the random numbers.
        variant, plugins: Mitsuba's variant, and modules that register other plugins.
        learned: A file of what the integrator has learned; empty for none. It need not be there
            yet: the first batch makes it.
        threads: Of a process; 0 for as many as there are cores.
        values: Of the loaded scene, as :func:`~mitsuba_ext.scene_values.as_text` makes them;
            ``None`` if no frame has any.
        description: What the image depends on, as JSON: a process that finds other files or
            another version of this package refuses. Empty for what each process finds.
    """

    scene: str
    size: tuple[int, int] | None = None
    definitions: tuple[tuple[str, str], ...] = ()
    specification: str | None = None
    sensor: int = 0
    seed: int = 0
    variant: str = "llvm_ad_rgb"
    plugins: tuple[str, ...] = ()
    learned: str = ""
    threads: int = 0
    values: str | None = None
    description: str = ""


class BatchRenderer:
    """Renders the batches of a request.

    Parameters:
        request: What to render; its variant is the active one.
        scenes: Keeps the scene.

    Attributes:
        chosen: The scene, the integrator and the sensor.
        sensor: The sensor.

    Raises:
        InputError: The scene, the integrator or the sensor cannot be used.
    """

    def __init__(self, request: RenderRequest, scenes: LastScene | None = None) -> None:
        if not dr.is_jit_v(mi.Float):
            raise InputError(
                f'batches need a variant such as "llvm_ad_rgb", and not "{mi.variant()}"'
            )
        self._request = request
        self.chosen = (scenes or LastScene()).choose(
            Path(request.scene), request.size, dict(request.definitions), request.specification,
            request.sensor, request.values,
        )  # fmt: skip
        self.sensor = self.chosen.sensor
        integrator = self.chosen.named.integrator
        # Its own file, if it has one, holds for all batches already
        self._learns = bool(
            request.learned
            and getattr(integrator, "can_learn", False)
            and not integrator.save_learned
            and not integrator.load_learned
        )

    @property
    def must_learn(self) -> bool:
        """Does the next batch teach those after it?"""
        return self._learns and not Path(self._request.learned).exists()

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

    def length(self, spp: int) -> int:
        """The samples per pixel of the next batch, of ``spp`` that are left. It does not depend on
        the speed, so that the same command gives the same image."""
        if can_render(self.chosen.named.integrator):
            return min(pass_length(self.sensor), spp)
        limit = _SAMPLES[dr.backend_v(mi.Float)] // math.prod(film_extent(self.sensor.film()))
        limit = max(limit, _SPP if is_independent(self.sensor) else _STRUCTURED_SPP)
        if self.must_learn:
            limit = max(limit, _LEARNING_SPP)
        return min(sample_count(self.sensor, 1 << (limit.bit_length() - 1)), spp)

    def render(self, batch: Batch) -> BatchResult:
        """
        Raises:
            InputError: The integrator cannot render this scene.
            KeyboardInterrupt: The batch was interrupted: it is lost.
        """
        loaded, named, film = self.chosen.loaded, self.chosen.named, self.sensor.film()
        integrator = named.integrator
        teaches, learned = self.must_learn, self._request.learned
        # It counts from the end of this batch on: what is learned depends on the batch's numbers,
        # and must not serve a second try
        unfinished = f"{learned}.part"
        if self._learns:
            integrator.load_learned = "" if teaches else learned
            integrator.save_learned = unfinished if teaches else ""
        seed = batch_seeds(batch.seed, 1, batch.index)[0]
        forget_memory_peak()
        begin = time.perf_counter()
        try:
            batches = each_batch(integrator, loaded.scene, self.sensor, batch.spp, [seed])
            images = next(batches)
        except (ValueError, TypeError, RuntimeError) as error:
            message = f'{loaded.source}: "{named.name}": {one_line(error)}'
            raise InputError(message) from error
        if has_taught := teaches and Path(unfinished).exists():
            os.replace(unfinished, learned)
        totals = RenderTotals.of(integrator, film, images.spp, time.perf_counter() - begin)
        sums = FilmSums()
        sums.add(film, images.spp)
        return BatchResult(
            batch._replace(spp=images.spp), sums.contents.astype(np.float32), sums.has_weights,
            images.mean.astype(np.float32), images.channels, images.image_channel_count,
            tuple(integrator.aov_names()), has_taught, totals,
        )  # fmt: skip


@functools.lru_cache(maxsize=1)
def _renderer(request: RenderRequest) -> BatchRenderer:
    select_variant(request.variant, request.plugins)
    if request.threads:
        dr.set_thread_count(request.threads)
    renderer = BatchRenderer(request)
    if request.description:
        found = json.loads(json.dumps(renderer.description(), default=str))
        if wrong := difference(json.loads(request.description), found):
            raise InputError(f"the worker {platform.node()} would render another image: {wrong}")
    return renderer


#: Held while a batch is rendered: a worker of Dask has several threads, and Dr.Jit uses all cores
#: for each batch.
_rendering = threading.Lock()


def render_batch(request: RenderRequest, batch: Batch) -> BatchResult:
    """Renders a batch in this process, which keeps the scene for the next one: what a worker
    does."""
    with _rendering:
        return _renderer(request).render(batch)
