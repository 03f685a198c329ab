"""Energy redistribution: renders with short chains that spread the energy of bright samples."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.learned_file import LearnedFile
from ...util.stored_arrays import StoredArrays
from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .chains import ChainRules, Chains
from .even_tiles import EvenTiles
from .noise_filters import FilteredChains, FilteredImage, NoiseFilters
from .numbers import stream
from .render import FIRST_STAGE, ChainRender
from .small_steps import SmallSteps
from .stored import PART, Arrays
from .target import Found

#: The saved totals over all batches, besides the image.
_TOTALS = ("samples", "batches", "redistributed", "energy")

#: The maximum number of chains of a batch.
_MAX_CHAINS = 1 << 17

#: The maximum numbers of samples and batches in a file.
_MAX_STORED = {"samples": 1 << 62, "batches": 1 << 31}

#: The random number stream of the first batch; later batches use the following streams.
_FIRST_STREAM = 16


@dataclass(frozen=True)
class RedistributionSettings:
    """The parameters of a render by energy redistribution.

    Attributes:
        chain_length: The number of mutations of a chain.
        mutations: The number of mutations per pixel if all energy is redistributed; 0 for the
            number of samples.
        outliers: The multiple of the neighbourhood's brightness beyond which chains redistribute a
            sample's energy. 0 redistributes all energy.
        luminance_samples: The number of samples that first measure the brightness.
        steps: The small steps of chains in primary sample space.
        filters: The noise filters.
        file: The file to which the last state is saved. If it holds a state, the render continues
            from it.
    """

    chain_length: int
    mutations: int
    outliers: float
    luminance_samples: int
    steps: SmallSteps
    filters: NoiseFilters = NoiseFilters()
    file: LearnedFile | None = None


class RedistributionRender(ChainRender):
    """Takes independent samples, and redistributes the part of their energy beyond a bound: chains
    of a fixed length start at these samples, and deposit equal amounts of energy at each state.
    ``spp`` is the number of samples per pixel.

    Samples are chosen by systematic sampling: their energies are added up, and a chain starts at a
    sample for each multiple of a common energy, shifted by a random offset, that lies between the
    sums before and after the sample. The expected number of chains is proportional to the energy,
    so no energy is lost on average.

    Source: D. Cline, PhD thesis, 2007, chapter 8 (equal deposition flow, section 8.3.2); B.
    Bitterli, W. Jarosz, *Selectively Metropolised Monte Carlo Light Transport Simulation*, ACM
    Transactions on Graphics 38(6), 2019 (chains for outliers only).

    Parameters:
        settings: The parameters of energy redistribution.
        render: The parameters of :class:`ChainRender`.

    Attributes:
        max_batch, max_timed_batch: The maximum number of samples of a batch, without and with a
            time limit. Each batch starts new chains, and few chains do not keep the processor busy.
    """

    max_batch, max_timed_batch = 1 << 22, 1 << 19

    def __init__(self, settings: RedistributionSettings, *render: Any) -> None:
        super().__init__(*render)
        self._settings = settings
        self._samples, self._batches, self._redistributed, self._energy = 0, 0, 0.0, 0.0

    def run(self, interrupt: threading.Event) -> None:
        settings, statistics, target = self._settings, self._statistics, self._target
        begin = time.perf_counter()
        statistics.interrupted = True
        seed = stream(self._seed, FIRST_STAGE)
        target.learn(seed)
        tiles = EvenTiles(self._film, settings.luminance_samples)
        first = Bootstrap(target, seed, settings.luminance_samples, tiles.take)
        statistics.learning_seconds += time.perf_counter() - begin
        bound = 0.0
        if settings.outliers > 0 and first.mean > 0:
            target.weights = tiles
            target.bound = bound = settings.outliers * first.mean
        image = self._image()
        rules = ChainRules(0.0, settings.steps, bound)
        # The energy of a deposit, in units of a sample's target function
        deposit = self._spp * first.mean / (settings.mutations or self._spp)
        stored = settings.file.load() if settings.file else None
        if stored:
            self._restore(stored.part(f"{PART}/"), image)
        left = max(0, self._spp * self._pixel_count - self._samples)
        is_timed = self._request.is_timed
        size = min(left, self.max_timed_batch if is_timed else self.max_batch)

        def act(most: int) -> int:
            self._batch(image, rules, size, deposit)
            return 1

        def write() -> None:
            factor = self._pixel_count * self._camera_spp / self._samples
            image.write(factor, factor, self._camera_spp)

        try:
            is_done = left == 0 or self._repeat(-(-left // size), size, interrupt, act, write)
            statistics.interrupted = not is_done
        finally:
            if self._batches > 0:
                write()
                self._report(round(self._samples / self._pixel_count))
                share = self._redistributed / self._energy if self._energy else 0.0
                statistics.learned = f"{share:.1%} of the energy was redistributed; {self._rates()}"
        # Not after an error, when a batch may be half done
        if settings.file:
            settings.file.save({PART: self._stored(image)})

    def _stored(self, image: ChainImage) -> Arrays:
        """The sums over completed batches; the next batch takes new samples."""
        tensors = {f"image{n}": np.array(tensor) for n, tensor in enumerate(image.tensors())}
        return {**tensors, **{key: np.array(getattr(self, f"_{key}")) for key in _TOTALS}}

    def _restore(self, stored: StoredArrays, image: ChainImage) -> None:
        image.restore(stored, [f"image{n}" for n in range(len(image.tensors()))])
        for key in _TOTALS:
            is_count = isinstance(getattr(self, f"_{key}"), int)
            least, most = (1, _MAX_STORED[key]) if is_count else (0, np.finfo(float).max)
            number = stored.number(key, "iu" if is_count else "f", least, most)
            setattr(self, f"_{key}", number)

    def _image(self) -> ChainImage:
        filters = self._settings.filters
        return FilteredImage(self._film, filters.width) if filters else ChainImage(self._film)

    def _chains(self, *chains: Any) -> Chains:
        filters = self._settings.filters
        return FilteredChains(filters, *chains) if filters else self._kind(*chains)

    def _batch(self, image: ChainImage, rules: ChainRules, size: int, deposit: float) -> None:
        """Adds a whole batch to the image, or nothing if there is an exception."""
        settings, target = self._settings, self._target
        part, energies = self._image(), []
        seed = stream(self._seed, _FIRST_STREAM + self._batches)

        def take(found: Found) -> None:
            """Adds the energy within the bound to the image."""
            kept = mi.Float(dr.select(found.target > 0, 0, 1))
            if target.bound > 0:
                kept = dr.rcp(1 + found.target / dr.opaque(mi.Float, target.bound))
            part.add_found(found, kept)
            energies.extend(float(dr.sum(mi.Float64(p.target))[0]) for p in found.parts)

        samples = Bootstrap(target, seed, size, take)
        self._statistics.rays["camera"] += samples.count
        energy = samples.mean * samples.count
        # Very bright samples start no more chains than if all energy were redistributed; each chain
        # carries more energy instead
        wanted = samples.count * settings.mutations / self._spp or samples.count
        most = min(_MAX_CHAINS, max(1.0, wanted / settings.chain_length))
        spacing = max(deposit * settings.chain_length, energy / most)
        winners = samples.choose_by_energy(spacing)
        if len(winners) > 0:
            chains = self._chains(
                target, part, rules, samples, winners, seed, spacing / settings.chain_length
            )
            while chains.done < settings.chain_length:
                length = min(chains.launch, settings.chain_length - chains.done)
                self._count(chains.advance(length), length * chains.count)
            chains.end()
        image.add_tensors(part.tensors())
        self._batches += 1
        self._samples += samples.count
        self._redistributed += energy
        self._energy += sum(energies)
