"""Renders batches with an integrator."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..rendering.batches import batch_seeds, each_batch, sample_count
from ..rendering.camera import film_extent
from ..rendering.film_sums import FilmSums
from ..rendering.plan import is_independent
from ..rendering.seed_passes import can_render, pass_length
from ..rendering.staged import is_staged
from ..rendering.totals import RenderTotals, forget_memory_peak
from ..util.errors import InputError
from .state import Batch, BatchResult, image_shape

#: The minimum samples per pixel of a batch of one of our integrators: with an independent sampler,
#: and with a stratified one.
_MIN_SPP, _MIN_STRUCTURED_SPP = 16, 64

#: A number of samples per pixel larger than in any batch.
_LARGER_THAN_A_BATCH = 1 << 24


class IntegratorBatches:
    """Renders batches.

    Parameters:
        integrator, scene, sensor, seed: The arguments of the render.

    Attributes:
        sensor, seed: The sensor and the seed.
        learns: Whether the integrator learns a state that other batches can load.
        batch_samples: By backend, the approximate number of samples in a batch of one of our
            integrators. Batches are this large because each traces its kernels and starts its
            Markov chains anew.
        learning_spp: The samples per pixel of the batch that learns for the others, if the render
            has that many.

    Raises:
        InputError: The variant is scalar.
    """

    batch_samples = {dr.JitBackend.LLVM: 1 << 22, dr.JitBackend.CUDA: 1 << 25}
    learning_spp = 128

    def __init__(
        self, integrator: mi.Integrator, scene: mi.Scene, sensor: mi.Sensor, seed: int
    ) -> None:
        if not dr.is_jit_v(mi.Float):
            raise InputError(
                f'batches need a variant such as "llvm_ad_rgb", and not "{mi.variant()}"'
            )
        self._integrator, self._scene, self.sensor = integrator, scene, sensor
        self.seed = seed
        # An integrator with save_learned or load_learned uses this file for all batches
        self.learns = bool(
            getattr(integrator, "can_learn", False)
            and not integrator.learned_state.has_file
        )

    def length(self, spp: int, teaches: bool) -> int:
        """The samples per pixel of the next batch, out of ``spp`` missing ones. The number does not
        depend on the speed, so the same command gives the same image.

        Args:
            teaches: Whether later batches use what it learns.
        """
        if can_render(self._integrator):
            return min(pass_length(self.sensor), spp)
        pixel_count = math.prod(film_extent(self.sensor.film()))
        limit = self.batch_samples[dr.backend_v(mi.Float)] // pixel_count
        limit = max(limit, _MIN_SPP if is_independent(self.sensor) else _MIN_STRUCTURED_SPP)
        if teaches:
            limit = max(limit, self.learning_spp)
        return min(sample_count(self.sensor, 1 << (limit.bit_length() - 1)), spp)

    def render(self, batch: Batch, learned: bytes | None = None) -> BatchResult:
        """
        Args:
            learned: The state learned by an earlier batch; empty if there was nothing to learn;
                ``None`` if this is the batch that learns.

        Raises:
            KeyboardInterrupt: The batch was interrupted, and is lost.
        """
        if not self.learns:
            return self._rendered(batch)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "learned.npz"
            if learned:
                file.write_bytes(learned)
                return self._rendered(batch, load_learned=str(file))
            if learned is not None:
                return self._rendered(batch)
            result = self._rendered(batch, save_learned=str(file))
            return result._replace(learned=file.read_bytes() if file.exists() else b"")

    def check(self, result: BatchResult) -> None:
        """Checks the result of a batch rendered by another process.

        Raises:
            InputError: The result is not an image of this film.
        """
        size, found = image_shape(self.sensor.film()), result.image.shape
        shapes = {found[:2], result.contents.shape[:2]}
        has_masks = bool(getattr(self._integrator, "masks", ()))
        if has_masks != (result.coverage is not None):
            raise InputError("a worker returned no masks: does it run the same version?")
        if shapes != {size} or found[2:] != (len(result.channels),) or result.batch.spp < 1:
            raise InputError(
                f"a worker returned an image of shape {found}, instead of one of {size[1]}x"
                f"{size[0]} pixels: does it run the same version?"
            )

    def _rendered(self, batch: Batch, **wishes: Any) -> BatchResult:
        """Renders a batch. ``wishes`` are attributes of its request."""
        integrator, film = self._integrator, self.sensor.film()
        seed = batch_seeds(batch.seed, 1, batch.index)[0]
        forget_memory_peak()
        begin = time.perf_counter()
        if is_staged(integrator):
            # Batches may be rendered in any order: count as if all had the usual length
            before = batch.index * max(batch.spp, self.length(_LARGER_THAN_A_BATCH, False))
            wishes.update(samples_before=before, is_batch=True, timeout=-1.0)
            wishes.update(progress=None, watch=None)  # of batches, nothing is shown
        images = next(
            each_batch(integrator, self._scene, self.sensor, batch.spp, [seed], **wishes)
        )
        totals = RenderTotals.of(integrator, film, images.spp, time.perf_counter() - begin)
        sums = FilmSums()
        sums.add(film, images.spp, getattr(integrator, "film_counts_samples", True))
        return BatchResult(
            batch._replace(spp=images.spp), sums.contents.astype(np.float32), sums.has_weights,
            images.mean.astype(np.float32), images.channels, images.image_channel_count,
            tuple(integrator.aov_names()), totals, coverage=getattr(integrator, "coverage", None),
        )  # fmt: skip
