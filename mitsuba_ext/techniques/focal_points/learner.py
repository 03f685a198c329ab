"""Learns focal points in pilots."""

from __future__ import annotations

from dataclasses import replace

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
from ...transport.observer import Observer
from ...util.arrays import from_numpy, to_host
from ...util.stored_arrays import StoredArrays
from .decisions import FocalScattering
from .fitting import LineArrays, fitted_boxes, fitted_rows
from .focal_density import FocalDensity
from .line_records import LineRecords, Lines, change_of_squares

#: The lines from which boxes are fitted, and the probabilities of each region.
_BOX_LINES, _REGION_LINES = 1 << 11, 1 << 14

#: The lines from which boxes are fitted that only show whether learning is hopeless, and about the
#: most lines of the paths that show it. With fewer lines than the last number, nothing is known.
_FEW_LINES, _SHOWING, _TOO_FEW = 1 << 9, 1 << 14, 3 << 7

#: The largest weight of a line, relative to the mean.
_HEAVIEST = 64.0

#: The most regions.
_MOST_REGIONS = 1 << 10

#: The largest factor by which a BSDF sample is thought to be rarer than a line that was found.
_RAREST = 1e6


class FocalLearner(Learner):
    """Learns focal points. Lines of the first pilot show whether that is hopeless: boxes are fitted
    to half of its paths, and the other half tells what they would gain. The second pilot draws
    directions to what the first one has found, and measures what that gains.

    Beside another learner of directions, it draws nothing unless the lines of the first pilot
    predict far less variance: the second pilot then predicts what the boxes of the first one would
    gain. If that is more than what the other learner gains, focal points take its place. Where the
    first pilots have few lines, it waits for more.

    Parameters:
        boxes: The most boxes.
        bounces: How many bounces of a path are recorded.
        least: The least number of the scout's vertices in a region.
        pilot_samples: Samples of all pilots together.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
        rival: The learner in the slot ``directions``; ``None`` if there is none, or if both are
            used.
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
        rival: Learner | None = None,
        always: bool = False,
    ) -> None:
        self._boxes, self._bounces, self._least = boxes, bounces, least
        self._pilot_samples, self._rival, self._always = pilot_samples, rival, always
        self._pixels, self._records = PixelEstimates(*film_size), None
        #: What was fitted to the last pilot, and whether the next one draws from it
        self._fitted: FocalScattering | None = None
        self._draws = rival is None
        self._effect: Effect | None = None
        self._summary = "no focal points: no path scatters"

    @property
    def decision(self) -> FocalScattering | None:
        return self._fitted if self._draws else None

    @property
    def replaces(self) -> tuple[str, ...]:
        is_alone = self._rival is not None and self._draws
        return ("directions", "roulette", "flights") if is_alone else ()

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> FocalScattering | None:
        if dr.width(p) == 0:
            return None
        regions = NestedRegions(p, n, self._least, _MOST_REGIONS)
        # As ``path``, but with the kernel of the pilots that follow
        self._fitted = FocalScattering(FocalDensity.nothing(regions.count), regions)
        self._records = LineRecords(regions, self._bounces, self._pixels)
        return self.decision

    @property
    def observer(self) -> Observer:
        return self._records or Observer()

    # ---- Between the stages ----

    def learn(self, pilot: Pilot) -> FocalScattering | None:
        records = self._records
        if records is None or self._fitted is None:
            return self.decision
        lines = records.lines()
        count = 0 if lines is None else len(lines.path)
        if count == 0 and pilot.is_last:
            return self._give_up("no path has found light")
        if count == 0 or (count < _TOO_FEW and not self._draws and not pilot.is_last):
            return self.decision  # until there are more
        bsdf = self._bsdf_density(lines)
        if not (self._is_worth(lines, bsdf, pilot) or self._always):
            less = 0 if self._effect is None else max(1 - self._effect.variance, 0)
            return self._give_up(f"about {less:.0%} less variance")
        self._fit(lines, bsdf)
        records.restart()
        if pilot.is_last and not self._fitted.density.has_boxes:
            # The kernel of path is faster
            self._effect = None
            return self._give_up("the pilots found none")
        return self.decision

    def _give_up(self, reason: str) -> None:
        if self._effect is not None:
            self._effect = replace(self._effect, is_kept=False)
        self._summary, self._fitted = f"no focal points: {reason}", None
        if self._rival is None or self._draws:
            self._records = None
        else:
            self._records.stop()  # so that the pilots that follow have the same kernel

    def _is_worth(self, lines: Lines, bsdf: mi.Float, pilot: Pilot) -> bool:
        """Whether the boxes of the pilot before the last one are worth their time; where there are
        none, whether boxes of the last one may be."""
        if not self._fitted.density.has_boxes:
            return self._may_be_worth(lines, bsdf, pilot)
        focal, path = self._variances(lines, bsdf, self._fitted.density)
        # What nothing was drawn from yet gets better
        known = self._records.paths / self._pilot_samples if self._draws else 0.0
        prediction = self._prediction(focal, path, self._fitted.density, known)
        if not pilot.pays(prediction):
            return False
        self._draws = self._draws or prediction.efficiency > self._rival.efficiency
        return self._draws

    def _may_be_worth(self, lines: Lines, bsdf: mi.Float, pilot: Pilot) -> bool:
        """Fits boxes to half of the paths, and predicts from the others what they would gain."""
        stride = max(1, len(lines.path) // _SHOWING)
        # All batches have such paths
        is_some = lines.path // BATCHES % dr.opaque(mi.UInt32, stride) == 0
        fits, shows = (dr.compress(is_some & (lines.path % 2 == odd)) for odd in (0, 1))
        if len(lines.path) < _TOO_FEW or not (len(fits) and len(shows)):
            return self._rival is None  # nothing is known
        some, bsdf_of_some = lines.chosen(fits), dr.gather(mi.Float, bsdf, fits)
        density = self._density(some, bsdf_of_some, _FEW_LINES, _FEW_LINES)
        others, bsdf_of_others = lines.chosen(shows), dr.gather(mi.Float, bsdf, shows)
        focal, path = self._variances(others, bsdf_of_others, density, stride)
        prediction = self._prediction(focal[1::2], path[1::2], density, known=0.0)
        if not pilot.pays(prediction):
            return False
        # Not where a few bright paths say so: half the error, because keyhole has one of 0.7
        is_far_less = prediction.variance * np.exp(prediction.error / 2) < verdicts.FAR_LESS
        self._draws = self._draws or is_far_less or (
            pilot.is_last and prediction.efficiency > self._rival.efficiency
        )
        return self._draws or not pilot.is_last

    def _prediction(
        self, focal: np.ndarray, path: np.ndarray, density: FocalDensity, known: float
    ) -> Prediction:
        """The prediction from the sums of :meth:`_variances`; sets the effect."""
        gain, error = gain_of(np.stack([focal, path - focal]))
        time = 1 + FOCAL_CHOICE + FOCAL_BOX * density.count
        self._effect = Effect(True, max(1 - gain, 1e-3), time)
        return Prediction(1 - gain, time, error, known, True)

    def _bsdf_density(self, lines: Lines) -> mi.Float:
        """The densities of the lines among BSDF samples."""
        if self.decision is None:
            return lines.pdf
        share, focus = _share_and_density(self.decision.density, lines)
        bsdf = (lines.pdf - share * focus) / (1 - share)
        # What is left by rounding may be negative
        bsdf = dr.maximum(bsdf, lines.pdf / _RAREST)
        dr.eval(bsdf)
        return bsdf

    def _variances(
        self, lines: Lines, bsdf: mi.Float, density: FocalDensity, stride: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """The squared errors of the paths of the last pilot, if directions were drawn from
        ``density`` and the BSDF, and if they were drawn from the BSDF; sums by batch.

        Parameters:
            stride: One in ``stride`` paths has lines.
        """
        share, focus = _share_and_density(density, lines)
        drawn = lines.pdf / lines.guided
        ratios = drawn / dr.lerp(bsdf, focus, share), drawn / bsdf
        dr.eval(ratios)
        focal, path = (
            self._records.variances + stride * change_of_squares(lines, ratio.numpy())
            for ratio in ratios
        )
        return np.maximum(focal, 1e-3 * np.maximum(path, 0)), path

    def _density(self, lines: Lines, bsdf: mi.Float, most: int, in_regions: int) -> FocalDensity:
        """Boxes for at most ``most`` of the lines, with probabilities of each region for at most
        ``in_regions``."""
        regions = self._fitted.regions
        value = lines.value.numpy().astype(np.float64)
        value = np.minimum(value, _HEAVIEST * value.mean())
        low, high, probability = fitted_boxes(_chosen(lines, bsdf, value, most), self._boxes)
        if len(low) == 0:
            return FocalDensity.nothing(regions.count)
        some = _chosen(lines, bsdf, value, in_regions)
        rows = fitted_rows(some, low, high, probability, regions.levels, regions.parent)
        return FocalDensity(low, high, rows)

    def _fit(self, lines: Lines, bsdf: mi.Float) -> None:
        density = self._density(lines, bsdf, _BOX_LINES, _REGION_LINES)
        self._fitted = FocalScattering(density, self._fitted.regions)
        self._summary = f"focal points: {density.count} boxes, {self._fitted.regions.count} regions"

    def state(self) -> dict[str, np.ndarray]:
        if self.decision is None:
            return {}
        return {**self.decision.density.state(), **_prefixed(self.decision.regions.state())}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> FocalScattering:
        regions = NestedRegions.of_state(state.part("regions/"))
        density = FocalDensity.of_state(state, regions.count)
        self._fitted, self._draws = FocalScattering(density, regions), True
        self._summary = f"focal points: {density.count} boxes, {regions.count} regions"
        return self.decision

    def finish(self) -> None:
        self._records = None

    @property
    def efficiency(self) -> float:
        if self._effect is None or self.decision is None:
            return 1.0
        return 1 / (self._effect.variance * self._effect.time)

    @property
    def growth(self) -> float:
        return 1.0 if self.decision is None else verdicts.FOCAL_POINTS_GROW

    @property
    def effect(self) -> Effect | None:
        return self._effect

    def __str__(self) -> str:
        if self._effect is None or self.decision is None:
            return self._summary
        less = 1 - self._effect.variance
        return f"{self._summary}, about {abs(less):.0%} {'more' if less < 0 else 'less'} variance"


def _share_and_density(density: FocalDensity, lines: Lines) -> tuple[mi.Float, mi.Float]:
    """For each line, the share of its region's directions that lead to boxes, and its density among
    them."""
    active = mi.Bool(True)
    focus = density.density(lines.region, lines.p, lines.d, active)
    return density.share(lines.region, active), focus


def _chosen(lines: Lines, bsdf: mi.Float, value: np.ndarray, most: int) -> LineArrays:
    """At most ``most`` of the lines, chosen by the light that was found along them."""
    running = np.cumsum(value) / value.sum()
    count = min(most, len(value))
    index = np.searchsorted(running, (np.arange(count) + 0.5) / count)
    index, times = np.unique(np.minimum(index, len(value) - 1), return_counts=True)
    where = from_numpy(mi.UInt32, index)
    columns = (*lines.p, *lines.d, lines.region, bsdf)
    # All at once: vectors alone would compile a kernel for each number of lines
    *found, region, density = to_host(*(dr.gather(type(x), x, where) for x in columns))
    p, d = np.stack(found[:3], axis=1), np.stack(found[3:], axis=1)
    return LineArrays(p, d, region, density, times.astype(np.float32))


def _prefixed(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"regions/{key}": value for key, value in state.items()}
