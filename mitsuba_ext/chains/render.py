"""Renders the part of an image that chains find."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ..rendering.camera import film_extent
from ..rendering.render import RenderStatistics, kernel_cache_misses
from ..rendering.time_budget import TimeBudget
from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .chains import ChainRules, Chains, Counts
from .even_tiles import EvenTiles
from .looped import LoopedChains
from .numbers import stream
from .small_steps import SmallSteps
from .stepped import SteppedChains
from .target import ImageTarget

#: Chains, without and with light paths, at most; and at least. Mutations of a chain, about, below
#: these bounds.
_MOST_CHAINS = {False: 1 << 16, True: 1 << 18}
_FEWEST_CHAINS, _LENGTH = 1 << 14, 64

#: Stream of random numbers, besides those of the bootstrap and of the chains.
_FIRST_STAGE = 5


@dataclass(frozen=True)
class ChainSettings:
    """The parameters of a Metropolis render.

    Attributes:
        chains: Chains, at most; there are no more than mutations. 0 for as many as suit the render.
        bootstrap: Samples from which they start, at least.
        large_step: The probability of a large step.
        steps: How numbers are moved by the others.
        uses_uniform: Are large steps used as uniform samples besides?
        is_even: Do a first stage's samples spread the visits evenly over the film?
    """

    chains: int
    bootstrap: int
    large_step: float
    steps: SmallSteps
    uses_uniform: bool
    is_even: bool = False


class Stoppable(Protocol):
    """What a render asks of its integrator."""

    timeout: float
    is_cancelled: bool
    progress: Callable[[float], None] | None


class ChainRender:
    """One render. The film must hold camera samples, to which the light of the chains is added.

    Parameters:
        integrator: Says when to stop.
        target: What is sampled.
        settings: How.
        seed: Of the random numbers.
        spp: Mutations per pixel.
        camera_spp: Camera samples per pixel that the film holds.
        statistics: Of the render so far; they are brought up to date.
        start: When it began, by ``time.perf_counter``.
    """

    def __init__(
        self,
        integrator: Stoppable,
        target: ImageTarget,
        settings: ChainSettings,
        seed: int,
        spp: int,
        camera_spp: int,
        statistics: RenderStatistics,
        start: float,
    ) -> None:
        self._integrator, self._target, self._settings = integrator, target, settings
        self._seed, self._spp, self._camera_spp = seed, spp, camera_spp
        self._statistics, self._start = statistics, start
        self._film = target.sensor.film()
        width, height = film_extent(self._film)
        self._pixel_count = width * height
        self._counts = {name: 0.0 for name in Counts.__dataclass_fields__}

    def run(self, interrupt: threading.Event) -> None:
        """Renders, and adds what was found to the film: also if an exception ends it."""
        settings, statistics = self._settings, self._statistics
        begin = time.perf_counter()
        statistics.interrupted = True
        total = self._spp * self._pixel_count
        count = min(settings.chains or _suitable(total, self._target), total)
        samples = max(settings.bootstrap, count)
        if settings.is_even:
            first = Bootstrap(self._target, stream(self._seed, _FIRST_STAGE), samples)
            if first.mean > 0:
                self._target.weights = EvenTiles(self._film, first.found)
            del first
        bootstrap = Bootstrap(self._target, self._seed, samples)
        statistics.learning_seconds += time.perf_counter() - begin
        if bootstrap.mean == 0:
            statistics.learned = "no light was found"
            statistics.interrupted = False
            return
        image = ChainImage(self._film)
        uniform_weight = settings.large_step * bootstrap.mean if settings.uses_uniform else 0.0
        rules = ChainRules(settings.large_step, settings.steps, uniform_weight)
        kind = SteppedChains if self._target.has_light_paths else LoopedChains
        chains = kind(self._target, image, rules, bootstrap, self._seed, count)
        try:
            self._advance(chains, -(-total // count), interrupt)
        finally:
            if chains.done > 0:
                chains.end()
                self._write(image, bootstrap, chains.done * count)

    def _advance(self, chains: Chains, steps: int, interrupt: threading.Event) -> None:
        integrator, statistics = self._integrator, self._statistics
        width = chains.count
        budget = TimeBudget(integrator.timeout, self._start, width, 0).stage(steps, 0, True)
        while chains.done < budget.samples:
            if interrupt.is_set() or integrator.is_cancelled:
                return
            begin, misses = time.perf_counter(), kernel_cache_misses()
            length = min(chains.launch, budget.longest, budget.samples - chains.done)
            self._count(chains.advance(length), length * width)
            dr.sync_thread()
            seconds = time.perf_counter() - begin
            if kernel_cache_misses() == misses:
                budget.passed(length, chains.done, seconds)
            statistics.passes += 1
            if integrator.progress is not None:
                integrator.progress(min(1.0, chains.done / budget.samples))
        statistics.interrupted = False

    def _count(self, counts: Counts, mutations: int) -> None:
        for name in self._counts:
            values = getattr(counts, name)
            self._counts[name] += float(dr.sum(mi.Float64(values))[0])
        rays = self._statistics.rays
        rays["camera"] += mutations

    def _write(self, image: ChainImage, bootstrap: Bootstrap, mutations: int) -> None:
        counts, statistics = self._counts, self._statistics
        # Uniform samples of the bootstrap and of large steps have the same mean
        uniform = bootstrap.count + counts["large"]
        mean = (bootstrap.mean * bootstrap.count + counts["large_target"]) / uniform
        per_mutation = self._pixel_count * self._camera_spp / mutations
        image.write(mean * per_mutation, bootstrap.mean * per_mutation, self._camera_spp)
        small = mutations - counts["large"]
        statistics.rays["scatter"] += int(counts["scatter"])
        statistics.rays["shadow"] += int(counts["shadow"])
        statistics.connections += int(counts["connections"])
        statistics.learned = (
            f"accepted: {_share(counts['accepted_large'], counts['large'])} of large steps, "
            f"{_share(counts['accepted_small'], small)} of small steps"
        )
        statistics.spp = round(mutations / self._pixel_count)


def _suitable(mutations: int, target: ImageTarget) -> int:
    """A number of chains. Longer chains forget better where they began; more of them keep the
    processor busy, above all where each mutation is several kernels."""
    most = _MOST_CHAINS[target.has_light_paths]
    return min(max(mutations // _LENGTH, _FEWEST_CHAINS), most)


def _share(part: float, whole: float) -> str:
    return f"{part / whole:.1%}" if whole else "none"
