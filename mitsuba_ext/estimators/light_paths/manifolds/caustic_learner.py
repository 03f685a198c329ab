"""Learns in pilots whether connections through casters pay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from ....planning import verdicts
from ....planning.costs import CHAIN_TRIAL, FIRST_CHAIN, SEGMENT, SHADOW
from ....planning.evidence import PathSums, gain_of
from ....planning.learner import Pilot
from ....planning.pixel_estimates import PixelEstimates, brightness
from ....planning.prediction import Effect, Prediction
from ....transport.estimator import Sample
from .seed_learner import ChainRecords, SeedLearner
from .shares import counted, taken_from_scattering

#: In the first pilot, one in this number of paths is connected, or fewer: about one in
#: ``_RENDER_STRIDE`` paths of the render, if the first pilot is a quarter of all. (A connection
#: takes up to thirty times as long as a path.)
_STRIDE, _RENDER_STRIDE = 8, 1024


class CausticLearner(SeedLearner):
    """Learns seeds where connections pay. The first pilot connects few of its paths. If these
    predict that connections pay, all paths of the later pilots are connected, and predict it again.

    A path with a connection shows the variance with connections. Without them, light that
    connections have found would be found by scattering, in few bright paths, which a pilot may not
    have. The trials of the connection tell how large the second moment would be (``shares.py``). A
    render of N samples may not have such paths either; their light is then missing. The second
    moment therefore counts as if none were brighter than N times the caustic in its pixel: with N
    samples, the error is then as large as the missing light. This includes light of points and
    directions, which scattering never finds.

    Parameters:
        make: Makes the decision.
        casters: The number of casters.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
        spp: Samples per pixel of the render.
        pilot_samples: Samples of all pilots together.
    """

    def __init__(
        self, make: Callable[..., Any], casters: int, film_size: tuple[int, int], spp: int,
        pilot_samples: int,
    ) -> None:
        super().__init__(make)
        self._spp, self._pilot_samples = spp, pilot_samples
        self._pixels, self._caustics = PixelEstimates(*film_size), PixelEstimates(*film_size)
        self._pixel_count = film_size[0] * film_size[1]
        most = spp * self._pixel_count / _RENDER_STRIDE
        # Odd, so that they do not lie in a few columns of the film
        self._stride = max(_STRIDE, round(pilot_samples / 4 / most)) | 1
        self._is_used = spp * self._pixel_count >= verdicts.least_of_casters(casters)
        self._effect: Effect | None = None
        self._restart()

    def _restart(self) -> None:
        #: Rays, shadow rays and trials, and the number of all paths of the stage
        self._sums, self._paths, self._rays = PathSums(2), 0, [0, 0]

    def start(self, scene, p, n):
        return self._make(self._map, self._record, self._stride) if self._is_used else None

    def learn(self, pilot):
        if not self._is_used:
            return None
        self._is_used = self._pays(pilot)
        if not self._is_used:
            self._records = []
            return None
        self._stride = 1
        self._restart()
        return super().learn(pilot)

    def _pays(self, pilot: Pilot) -> bool:
        """Whether connections pay, as the last pilot predicts."""
        if self._paths == 0:
            return False
        batches, (*_, chains, trials) = self._sums.read()
        if chains == 0:
            return False
        gain, error = gain_of(batches)
        connected = self._paths / self._stride
        rays, shadow_rays = self._rays
        of_path = SEGMENT * (self._paths + rays) + SHADOW * shadow_rays
        time = 1 + (FIRST_CHAIN + CHAIN_TRIAL * trials / connected) * self._paths / of_path
        self._effect = Effect(True, max(1 - gain, 1e-3), time)
        known = connected / self._pilot_samples
        prediction = Prediction(1 - gain, time, error, known, True)
        least = verdicts.CAUSTICS if self._stride > 1 else verdicts.LATER_CAUSTICS
        is_worth = prediction.efficiency >= least and pilot.pays(prediction)
        if not is_worth:
            self._effect = Effect(False, self._effect.variance, time)
        return is_worth

    def _record(self, chains: ChainRecords, sample: Sample, pixel: mi.UInt32) -> None:
        super()._record(chains, sample, pixel)
        lanes = dr.width(pixel)
        self._paths += lanes
        for i, count in enumerate((sample.scatter_count, sample.shadow_count)):
            self._rays[i] += int(dr.sum(mi.UInt64(count))[0])
        index = dr.arange(mi.UInt32, -(-lanes // self._stride)) * dr.opaque(
            mi.UInt32, self._stride
        )
        pixel, light, ratio, trials, total = (
            dr.gather(type(x), x, index)
            for x in (pixel, chains.light, chains.ratio, chains.trials, brightness(sample.L))
        )
        light = dr.select(dr.isfinite(light), light, 0)
        found = light * counted(trials, ratio)
        self._pixels.add(pixel, total)
        self._caustics.add(pixel, found)
        weight, error = self._pixels.importance(pixel, total)
        of_caustic, _ = self._caustics.importance(pixel, found)
        # The light that all samples of the pixel, and of the film, bring of the caustic
        of_pixel = dr.opaque(mi.Float, self._spp) * dr.rsqrt(of_caustic)
        of_film = of_pixel * dr.opaque(mi.Float, self._pixel_count)
        scattered = dr.select(light < of_film * ratio, light / ratio, of_pixel)
        taken = light * scattered * taken_from_scattering(trials, ratio)
        more = weight * (taken - dr.square(found))
        n = mi.Float(trials)
        again = ratio * (0.5 * n * (n + 1))  # trials for light that scattering finds
        self._sums.add(
            dr.select(dr.isfinite(error), error, 0), dr.select(dr.isfinite(more), more, 0),
            dr.select(trials > 0, mi.Float(1), 0), n + again,
        )  # fmt: skip

    def state(self):
        return super().state() if self._is_used else {}

    def restore(self, scene, state):
        self._is_used = True
        return super().restore(scene, state)

    @property
    def effect(self) -> Effect | None:
        return self._effect

    def __str__(self):
        if self._effect is None:
            return super().__str__() if self._is_used else ""
        less = f"about {1 - self._effect.variance:.0%} less variance"
        if not self._is_used:
            return f"no connections through glass and mirrors: {less}"
        return f"{super().__str__()}, {less}"
