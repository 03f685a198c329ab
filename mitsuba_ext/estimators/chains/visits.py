"""Renders with long chains: Metropolis light transport."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.learned_file import LearnedFile
from ...rendering.pace import Pace
from ...util.stored_arrays import StoredArrays
from .bootstrap import Bootstrap
from .chain_image import ChainImage
from .chains import ChainRules, Chains
from .even_tiles import EvenTiles
from .numbers import stream
from .render import FIRST_STAGE, ChainRender
from .small_steps import SmallSteps
from .stored import PART, Arrays
from .target import Found, ImageTarget

#: For estimators without and with light paths: the minimum and the maximum number of chains, and
#: the approximate number of mutations of a chain within these bounds. Longer chains depend less on
#: the bright samples at which they start. With light paths, each mutation needs several kernels,
#: and tracing them takes as long as running 65536 mutations.
_CHAINS, _LENGTH = {False: (1 << 10, 1 << 16), True: (1 << 16, 1 << 18)}, {False: 1024, True: 64}

#: The number of bootstrap samples, as a fraction of the mutations, and its maximum. Their mean
#: gives the brightness of the chains' image.
_BOOTSTRAP_SHARE, _MAX_BOOTSTRAP = 0.25, 1 << 24

#: With a time limit: the fraction of the remaining time that the bootstrap takes, and the number of
#: samples that measure its speed.
_BOOTSTRAP_TIME, _SPEED_SAMPLES = 0.2, 1 << 16

#: The relative standard error of the brightness above which there is a warning.
_MAX_BRIGHTNESS_ERROR = 0.05

#: The number of samples that estimate the scale of MIS weights.
_SCALE_SAMPLES = 1 << 14


@dataclass(frozen=True)
class ChainSettings:
    """The parameters of a Metropolis render.

    Attributes:
        chains: The maximum number of chains, which never exceeds the number of mutations; 0 for a
            number that suits the render.
        bootstrap: The minimum number of samples from which the starts are chosen.
        large_step: The probability of a large step.
        steps: The small steps.
        uses_uniform: Whether the proposals of large steps are also used as independent samples.
        is_even: Whether there is a first stage, whose samples make the visits even over the film.
        file: The file to which the last state is saved. If it holds a state, the render continues
            from it.
    """

    chains: int
    bootstrap: int
    large_step: float
    steps: SmallSteps
    uses_uniform: bool
    is_even: bool = False
    file: LearnedFile | None = None


@dataclass(frozen=True)
class Start:
    """The samples at which chains started.

    Attributes:
        mean: The mean of the target function.
        count: The number of samples.
        error: The standard error of the mean, divided by the mean.
    """

    mean: float
    count: int
    error: float


class MetropolisRender(ChainRender):
    """Metropolis light transport: long chains visit the film in proportion to the brightness of the
    image. ``spp`` is the number of mutations per pixel.

    Parameters:
        settings: The parameters of the chains.
        render: The parameters of :class:`ChainRender`.

    Attributes:
        long_stay, long_stay_fraction: The number of consecutive visits of a chain to a state above
            which there is a warning: an absolute number, and a fraction of the visits of an average
            pixel; both must be exceeded.
    """

    long_stay, long_stay_fraction = 64, 0.5

    def __init__(self, settings: ChainSettings, *render: Any) -> None:
        super().__init__(*render)
        self._settings = settings

    def run(self, interrupt: threading.Event) -> None:
        statistics = self._statistics
        begin = time.perf_counter()
        statistics.interrupted = True
        total, image = self._spp * self._pixel_count, ChainImage(self._film)
        file = self._settings.file
        stored = file.load() if file else None
        try:
            if stored:
                chains, start = self._restored(stored.part(f"{PART}/"), image)
            else:
                chains, start = self._begun(total, image, interrupt)
        except _StoppedError:
            return
        finally:
            statistics.learning_seconds += time.perf_counter() - begin
        if chains is None:
            statistics.learned = (
                f"the chains found no light: the image is {self._camera_spp} camera samples per "
                f"pixel"
            )
            statistics.interrupted = False
            return
        count = chains.count

        def act(most: int) -> int:
            length = min(chains.launch, most)
            self._count(chains.advance(length), length * count)
            return length

        def put() -> None:
            self._put(chains, image, start)

        try:
            left = max(0, -(-total // count) - chains.done)
            is_done = left == 0 or self._repeat(left, count, interrupt, act, put)
            statistics.interrupted = not is_done
        finally:
            if chains.done > 0:
                self._write(chains, image, start)
        # Not after an error, when the chains may be amid a launch
        if file:
            file.save({PART: self._stored(chains, image, start)})

    def _begun(
        self, total: int, image: ChainImage, interrupt: threading.Event
    ) -> tuple[Chains | None, Start]:
        """New chains and their start; ``None`` instead of the chains if no light was found."""
        settings, statistics = self._settings, self._statistics
        count = min(settings.chains or _suitable(total, self._target), total)
        mean = self._first_stage()
        samples = max(settings.bootstrap, count, self._bootstrap_share(total))
        # Independent samples per mutation, from large steps and from the bootstrap
        share = settings.large_step + _BOOTSTRAP_SHARE
        rules = ChainRules(
            settings.large_step, settings.steps, share * mean if settings.uses_uniform else 0.0
        )

        def take(found: Found) -> None:
            if interrupt.is_set() or self._integrator.is_cancelled:
                raise _StoppedError
            if rules.uniform_weight > 0:
                # Opaque, because a literal would need another kernel in each render
                scale = dr.opaque(mi.Float, rules.uniform_weight)
                weight = dr.select(found.target > 0, dr.rcp(found.target + scale), 0)
                image.add_found(found, weight)

        bootstrap = Bootstrap(self._target, self._seed, samples, take)
        statistics.rays["camera"] += bootstrap.count
        start = Start(bootstrap.mean, bootstrap.count, bootstrap.error)
        if bootstrap.mean == 0:
            return None, start
        winners = bootstrap.choose(count)
        return self._kind(self._target, image, rules, bootstrap, winners, self._seed), start

    def _restored(self, stored: StoredArrays, image: ChainImage) -> tuple[Chains, Start]:
        """The stored chains and their start; the stored image is added to ``image``."""
        settings = self._settings
        if settings.is_even:
            self._first_stage()
        else:
            self._target.learn(stream(self._seed, FIRST_STAGE))
        image.restore(stored, ("visits", "uniform"))
        limit = float(np.finfo(np.float32).max)
        uniform_weight = stored.number("uniform_weight", "f", 0, limit)
        rules = ChainRules(settings.large_step, settings.steps, uniform_weight)
        chains = self._kind(
            self._target, image, rules, None, None, self._seed, stored=stored
        )
        start = Start(
            stored.number("mean", "f", 0, limit), stored.number("samples", "iu", 1, 1 << 62),
            stored.number("error", "f", 0, np.inf),
        )  # fmt: skip
        return chains, start

    def _stored(self, chains: Chains, image: ChainImage, start: Start) -> Arrays:
        visits, uniform = (np.array(tensor) for tensor in image.tensors())
        return {
            "visits": visits, "uniform": uniform, "mean": np.array(start.mean),
            "samples": np.array(start.count), "error": np.array(start.error),
            "uniform_weight": np.array(chains.rules.uniform_weight), **chains.stored(),
        }  # fmt: skip

    def _first_stage(self) -> float:
        """Estimates the mean of the target function, which scales MIS weights. Any scale is
        unbiased if it does not depend on the image's samples. Also computes tile weights."""
        settings = self._settings
        seed, samples = stream(self._seed, FIRST_STAGE), settings.bootstrap
        self._target.learn(seed)
        if not settings.is_even:
            return Bootstrap(self._target, seed, min(samples, _SCALE_SAMPLES)).mean
        tiles = EvenTiles(self._film, samples)
        scale = Bootstrap(self._target, seed, samples, tiles.take).mean
        self._target.weights = tiles
        return scale

    def _bootstrap_share(self, total: int) -> int:
        share = int(_BOOTSTRAP_SHARE * total)
        if self._request.is_timed and share > self._settings.bootstrap:
            share = min(share, self._timed_share())
        return min(share, _MAX_BOOTSTRAP)

    def _timed_share(self) -> int:
        """The number of bootstrap samples that suits the time limit. Separate samples measure the
        speed, because the number of samples used must not depend on their values."""
        # The first stage has compiled the kernels
        begin, pace = time.perf_counter(), Pace()
        seed = stream(self._seed, FIRST_STAGE)
        count = Bootstrap(self._target, seed, _SPEED_SAMPLES).count
        pace.measure(count, time.perf_counter() - begin)
        left = self._request.timeout - (time.perf_counter() - self._start)
        return int(pace.fits(_BOOTSTRAP_TIME * left))

    def _put(self, chains: Chains, image: ChainImage, start: Start) -> int:
        """Adds the image to the film. Returns the number of mutations."""
        chains.end()
        mutations = chains.done * chains.count
        camera_samples = self._pixel_count * self._camera_spp
        # The mean of the samples at which the chains started, not a more precise one: only with
        # this mean is the product with the visits unbiased
        visit_factor = start.mean * camera_samples / mutations
        uniform = self._settings.large_step * mutations + start.count
        uniform_factor = chains.rules.uniform_weight * camera_samples / uniform
        image.write(visit_factor, uniform_factor, self._camera_spp)
        return mutations

    def _write(self, chains: Chains, image: ChainImage, start: Start) -> None:
        mutations = self._put(chains, image, start)
        self._report(round(mutations / self._pixel_count))
        longest = self._counts["longest"]
        self._statistics.learned = (
            f"{self._rates()}; brightness known to {start.error:.1%}; a chain stayed at one path "
            f"for {longest:.0f} of {chains.done} mutations"
        )
        if longest > max(self.long_stay, self.long_stay_fraction * mutations / self._pixel_count):
            mi.Log(
                mi.LogLevel.Warn,
                f"A chain stayed at one path for {longest:.0f} of {chains.done} mutations: some "
                f'pixels may be far too bright. "erpt" limits the contribution of one path.',
            )
        if start.error > _MAX_BRIGHTNESS_ERROR:
            mi.Log(
                mi.LogLevel.Warn,
                f"The light that the chains found may be too bright or too dark as a whole: the "
                f"standard error of its brightness is {start.error:.0%}. Use more "
                f'"luminance_samples".',
            )


class _StoppedError(Exception):
    """The render was interrupted or cancelled."""


def _suitable(mutations: int, target: ImageTarget) -> int:
    """A suitable number of chains. Longer chains depend less on their starts. More chains keep the
    processor busy, especially if each mutation consists of several kernels."""
    fewest, most = _CHAINS[target.has_light_paths]
    return min(max(mutations // _LENGTH[target.has_light_paths], fewest), most)
