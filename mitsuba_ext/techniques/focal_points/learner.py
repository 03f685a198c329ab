"""Learns focal points in pilots."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning import verdicts
from ...planning.costs import FOCAL_BOX, FOCAL_CHOICE
from ...planning.evidence import BATCHES, gain_of
from ...planning.learner import Learner, Pilot
from ...planning.pixel_estimates import PixelEstimates
from ...planning.prediction import Effect, Prediction
from ...scene.regions.nested_regions import NestedRegions
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays
from .decisions import FocalScattering
from .fitting import LineArrays, fitted_boxes, fitted_rows
from .focal_density import FocalDensity
from .line_records import LineRecords, Lines

#: The lines from which boxes are fitted, and the probabilities of each region.
_BOX_LINES, _REGION_LINES = 1 << 11, 1 << 14

#: The largest weight of a line, relative to the mean.
_HEAVIEST = 64.0

#: The most regions.
_MOST_REGIONS = 1 << 10

#: The largest factor by which a BSDF sample is thought to be rarer than a line that was found.
_RAREST = 1e6


class FocalLearner(Learner):
    """Learns focal points. The second pilot draws directions to what the first one has found, and
    measures what that gains.

    Parameters:
        boxes: The most boxes.
        bounces: How many bounces of a path are recorded.
        least: The least number of the scout's vertices in a region.
        pilot_samples: Samples of all pilots together.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
        always: Draw such directions also where that does not pay?

    Attributes:
        decision (FocalScattering): The decision of the next stage; ``None`` for the one of
            ``path``.
    """

    wants_scout = True

    def __init__(
        self,
        boxes: int,
        bounces: int,
        least: float,
        pilot_samples: int,
        film_size: tuple[int, int],
        always: bool = False,
    ) -> None:
        self._boxes, self._bounces, self._least = boxes, bounces, least
        self._pilot_samples, self._always = pilot_samples, always
        self._pixels, self._records = PixelEstimates(*film_size), None
        self.decision: FocalScattering | None = None
        self._effect: Effect | None = None
        self.discards_pilots = False
        self._summary = "no focal points: no path scatters"

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> FocalScattering | None:
        if dr.width(p) == 0:
            return None
        regions = NestedRegions(p, n, self._least, _MOST_REGIONS)
        # As ``path``, but with the kernel of the pilots that follow
        self.decision = FocalScattering(FocalDensity.nothing(regions.count), regions)
        self._records = LineRecords(self.decision.region, self._bounces, self._pixels)
        return self.decision

    # ---- Observer ----

    def kernel_state(self) -> list[Any]:
        """The attributes on which kernels depend (``frozen.py``)."""
        return [] if self._records is None else [self._records]

    def begin(self, *arguments: Any) -> None:
        if self._records is not None:
            self._records.begin(*arguments)

    def direction(self, *arguments: Any) -> None:
        if self._records is not None:
            self._records.direction(*arguments)

    def scattering(self, *arguments: Any) -> None:
        if self._records is not None:
            self._records.scattering(*arguments)

    def end(self, L: mi.Spectrum) -> None:
        if self._records is not None:
            self._records.end(L)

    # ---- Between the stages ----

    def learn(self, pilot: Pilot) -> FocalScattering | None:
        self.discards_pilots = False
        records = self._records
        if records is None:
            return self.decision
        lines = records.lines()
        if lines is None:
            if pilot.is_last:
                self._summary = "no focal points: no path has found light"
                self.decision = self._records = None
            records.restart()
            return self.decision
        bsdf = self._bsdf_density(lines)
        if self.decision.density.table[:, 0].any():
            gain, error = self._gain(lines, bsdf)
            known = records.paths / self._pilot_samples
            time = 1 + FOCAL_CHOICE + FOCAL_BOX * self.decision.density.count
            is_first = self._effect is None
            self._effect = Effect(True, max(1 - gain, 1e-3), time)
            prediction = Prediction(1 - gain, time, error, known, True)
            if not (self._always or pilot.pays(prediction)):
                self._effect = Effect(False, max(1 - gain, 1e-3), time)
                self._summary = f"no focal points: about {max(gain, 0):.0%} less variance"
                self.decision = self._records = None
                return None
            self.discards_pilots = is_first and 1 - gain < verdicts.FAR_LESS
        self._fit(lines, bsdf)
        records.restart()
        if pilot.is_last and not self.decision.density.table[:, 0].any():
            # The kernel of path is faster
            self._summary = "no focal points: the pilots found none"
            self.decision = self._records = self._effect = None
        return self.decision

    def _bsdf_density(self, lines: Lines) -> mi.Float:
        """The densities of the lines among BSDF samples, from their densities in the mixture."""
        density, active = self.decision.density, mi.Bool(True)
        share = density.share(lines.region, active)
        focus = density.density(lines.region, lines.p, lines.d, active)
        bsdf = (lines.pdf - share * focus) / (1 - share)
        # What is left by rounding may be negative
        bsdf = dr.maximum(bsdf, lines.pdf / _RAREST)
        dr.eval(bsdf)
        return bsdf

    def _gain(self, lines: Lines, bsdf: mi.Float) -> tuple[float, float]:
        """By how much focal points have reduced the variance of the last pilot, to first order in
        the vertices of a path; and the error of this estimate, see :func:`gain_of`."""
        more = dr.square(mi.Float64(lines.value)) * mi.Float64(lines.pdf / bsdf - 1)
        more = np.nan_to_num(more.numpy(), posinf=0.0, neginf=0.0)
        sums = np.bincount(lines.batch.numpy(), more, BATCHES)
        return gain_of(np.stack([self._records.variances, sums]))

    def _fit(self, lines: Lines, bsdf: mi.Float) -> None:
        value = lines.value.numpy().astype(np.float64)
        value = np.minimum(value, _HEAVIEST * value.mean())
        low, high, probability = fitted_boxes(_chosen(lines, bsdf, value, _BOX_LINES), self._boxes)
        regions = self.decision.regions
        if len(low) == 0:
            density = FocalDensity.nothing(regions.count)
        else:
            some = _chosen(lines, bsdf, value, _REGION_LINES)
            rows = fitted_rows(some, low, high, probability, regions.levels, regions.parent)
            density = FocalDensity(low, high, rows)
        self.decision = FocalScattering(density, regions)
        self._summary = f"focal points: {len(low)} boxes, {regions.count} regions"

    def state(self) -> dict[str, np.ndarray]:
        if self.decision is None:
            return {}
        return {**self.decision.density.state(), **_prefixed(self.decision.regions.state())}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> FocalScattering:
        regions = NestedRegions.of_state(state.part("regions/"))
        density = FocalDensity.of_state(state, regions.count)
        self.decision = FocalScattering(density, regions)
        self._summary = f"focal points: {density.count} boxes, {regions.count} regions"
        return self.decision

    def finish(self) -> None:
        self._records = None

    @property
    def effect(self) -> Effect | None:
        return self._effect

    def __str__(self) -> str:
        if self._effect is None or self.decision is None:
            return self._summary
        less = 1 - self._effect.variance
        return f"{self._summary}, about {abs(less):.0%} {'more' if less < 0 else 'less'} variance"


def _chosen(lines: Lines, bsdf: mi.Float, value: np.ndarray, most: int) -> LineArrays:
    """At most ``most`` of the lines, chosen by the light that was found along them."""
    running = np.cumsum(value) / value.sum()
    count = min(most, len(value))
    index = np.searchsorted(running, (np.arange(count) + 0.5) / count)
    index, times = np.unique(np.minimum(index, len(value) - 1), return_counts=True)
    where = from_numpy(mi.UInt32, index)
    p, d = (dr.gather(type(x), x, where).numpy().T for x in (lines.p, lines.d))
    region = dr.gather(mi.UInt32, lines.region, where).numpy()
    density = dr.gather(mi.Float, bsdf, where).numpy()
    return LineArrays(p, d, region, density, times.astype(np.float32))


def _prefixed(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"regions/{key}": value for key, value in state.items()}
