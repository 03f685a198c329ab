"""Renders with short chains that spread the energy of bright samples: energy redistribution."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .chains import ChainRules, Chains
from .even_tiles import EvenTiles
from .noise_filters import FilteredChains, FilteredImage, NoiseFilters
from .numbers import stream
from .render import FIRST_STAGE, ChainRender
from .small_steps import SmallSteps
from .stored import Arrays, StateFile
from .target import Found

#: Samples of a batch, at most, and with a time limit. Each batch has chains of its own, which take
#: long where they are few.
_BATCH, _TIMED_BATCH = 1 << 22, 1 << 19

#: What is known of all batches, besides the image.
_SUMS = ("samples", "batches", "redistributed", "energy")

#: Chains of a batch, at most.
_MOST_CHAINS = 1 << 17

#: Streams of random numbers of batches, besides all others: this one and the next ones.
_BATCHES = 16


@dataclass(frozen=True)
class RedistributionSettings:
    """The parameters of a render by energy redistribution.

    Attributes:
        chain_length: Mutations of a chain.
        mutations: Mutations per pixel, if all energy were redistributed; 0 for as many as samples.
        outliers: Samples so many times as bright as their neighbourhood lose what they have beyond
            that to chains. 0 redistributes all energy.
        luminance_samples: Samples that measure brightness first.
        steps: How numbers are moved, where chains change those.
        filters: Of the noise.
        file: If it has a state, the render goes on from there; it has the last state afterwards.
    """

    chain_length: int
    mutations: int
    outliers: float
    luminance_samples: int
    steps: SmallSteps
    filters: NoiseFilters = NoiseFilters()
    file: StateFile | None = None


class RedistributionRender(ChainRender):
    """Takes independent samples. From the energy that is beyond a bound, chains of a fixed length
    start, and deposit equal shares of it where they go. ``spp`` are samples per pixel.

    The number of chains of a sample is that of the multiples of a common energy, shifted by a
    random offset, between the sums of energies before and after it: right on average, so that
    nothing is lost.

    Source: D. Cline, PhD thesis, 2007, chapter 8 (equal deposition flow, section 8.3.2); B.
    Bitterli, W. Jarosz, *Selectively Metropolised Monte Carlo Light Transport Simulation*, ACM
    Transactions on Graphics 38(6), 2019 (chains for outliers only).

    Parameters:
        settings: How.
    """

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
        # Energy of a deposit, in units of the target function of a sample
        deposit = self._spp * first.mean / (settings.mutations or self._spp)
        stored = settings.file.load() if settings.file else None
        if stored:
            self._restore(stored, image)
        left = max(0, self._spp * self._pixel_count - self._samples)
        size = min(left, _TIMED_BATCH if self._integrator.timeout > 0 else _BATCH)

        def act(most: int) -> int:
            self._batch(image, rules, size, deposit)
            return 1

        try:
            is_done = left == 0 or self._repeat(-(-left // size), size, interrupt, act)
            statistics.interrupted = not is_done
        finally:
            if self._batches > 0:
                factor = self._pixel_count * self._camera_spp / self._samples
                image.write(factor, factor, self._camera_spp)
                self._report(round(self._samples / self._pixel_count))
                share = self._redistributed / self._energy if self._energy else 0.0
                statistics.learned = f"{share:.1%} of the energy was redistributed; {self._rates()}"
        # Not after an error: a batch may be half done
        if settings.file:
            settings.file.save(self._stored(image))

    def _stored(self, image: ChainImage) -> Arrays:
        """Batches that are done. The next one begins with samples of its own."""
        tensors = {f"image{n}": np.array(tensor) for n, tensor in enumerate(image.tensors())}
        return {**tensors, **{key: np.array(getattr(self, f"_{key}")) for key in _SUMS}}

    def _restore(self, stored: Arrays, image: ChainImage) -> None:
        image.add_tensors([mi.TensorXf(stored[f"image{n}"]) for n in range(len(image.tensors()))])
        for key in _SUMS:
            setattr(self, f"_{key}", stored[key].item())

    def _image(self) -> ChainImage:
        filters = self._settings.filters
        return FilteredImage(self._film, filters.width) if filters else ChainImage(self._film)

    def _chains(self, *chains: Any) -> Chains:
        filters = self._settings.filters
        return FilteredChains(filters, *chains) if filters else self._kind(*chains)

    def _batch(self, image: ChainImage, rules: ChainRules, size: int, deposit: float) -> None:
        """Adds a batch to the image: all of it, or nothing if an exception ends it."""
        settings, target = self._settings, self._target
        part, energies = self._image(), []
        seed = stream(self._seed, _BATCHES + self._batches)

        def take(found: Found) -> None:
            """Adds what is within the bound to the image."""
            kept = mi.Float(dr.select(found.target > 0, 0, 1))
            if target.bound > 0:
                kept = dr.rcp(1 + found.target / dr.opaque(mi.Float, target.bound))
            part.add_found(found, kept)
            energies.extend(float(dr.sum(mi.Float64(p.target))[0]) for p in found.parts)

        samples = Bootstrap(target, seed, size, take)
        self._statistics.rays["camera"] += samples.count
        energy = samples.mean * samples.count
        # A very bright sample does not make more chains than all energy would: they carry more
        wanted = samples.count * settings.mutations / self._spp or samples.count
        most = min(_MOST_CHAINS, max(1.0, wanted / settings.chain_length))
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
