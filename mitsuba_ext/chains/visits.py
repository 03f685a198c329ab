"""Renders with long chains: Metropolis light transport."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .chains import ChainRules, Chains
from .even_tiles import EvenTiles
from .numbers import stream
from .render import FIRST_STAGE, ChainRender
from .small_steps import SmallSteps
from .target import ImageTarget

#: Chains without and with light paths, at least and at most: these need several kernels for each
#: mutation, which take as long to trace as 65536 mutations. Mutations of a chain, about, where
#: these bounds allow it.
_CHAINS, _LENGTH = {False: (1 << 14, 1 << 16), True: (1 << 16, 1 << 18)}, 64


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


class MetropolisRender(ChainRender):
    """Chains visit all of the image in proportion to its brightness. ``spp`` are mutations per
    pixel.

    Parameters:
        settings: How.
    """

    def __init__(self, settings: ChainSettings, *render: Any) -> None:
        super().__init__(*render)
        self._settings = settings

    def run(self, interrupt: threading.Event) -> None:
        settings, statistics = self._settings, self._statistics
        begin = time.perf_counter()
        statistics.interrupted = True
        total = self._spp * self._pixel_count
        count = min(settings.chains or _suitable(total, self._target), total)
        samples = max(settings.bootstrap, count)
        if settings.is_even:
            tiles = EvenTiles(self._film, samples)
            Bootstrap(self._target, stream(self._seed, FIRST_STAGE), samples, tiles.take)
            self._target.weights = tiles
        bootstrap = Bootstrap(self._target, self._seed, samples)
        statistics.learning_seconds += time.perf_counter() - begin
        if bootstrap.mean == 0:
            statistics.learned = "no light was found"
            statistics.interrupted = False
            return
        image = ChainImage(self._film)
        uniform_weight = settings.large_step * bootstrap.mean if settings.uses_uniform else 0.0
        rules = ChainRules(settings.large_step, settings.steps, uniform_weight)
        winners = bootstrap.choose(count)
        chains = self._kind(self._target, image, rules, bootstrap, winners, self._seed)

        def act(most: int) -> int:
            length = min(chains.launch, most)
            self._count(chains.advance(length), length * count)
            return length

        try:
            is_done = self._repeat(-(-total // count), count, interrupt, act)
            statistics.interrupted = not is_done
        finally:
            if chains.done > 0:
                chains.end()
                self._write(chains, image, bootstrap)

    def _write(self, chains: Chains, image: ChainImage, bootstrap: Bootstrap) -> None:
        counts = self._counts
        # Uniform samples of the bootstrap and of large steps have the same mean
        uniform = bootstrap.count + counts["large"]
        mean = (bootstrap.mean * bootstrap.count + counts["large_target"]) / uniform
        mutations = chains.done * chains.count
        per_mutation = self._pixel_count * self._camera_spp / mutations
        image.write(mean * per_mutation, bootstrap.mean * per_mutation, self._camera_spp)
        self._report(round(mutations / self._pixel_count))
        self._statistics.learned = self._rates()


def _suitable(mutations: int, target: ImageTarget) -> int:
    """A number of chains. Longer chains forget better where they began; more of them keep the
    processor busy, above all where each mutation is several kernels."""
    fewest, most = _CHAINS[target.has_light_paths]
    return min(max(mutations // _LENGTH, fewest), most)
