"""Learning the densities of the primary samples that choose directions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.costs import FIRST_GUIDED, GUIDED, RAYS_PER_SEGMENT
from ...planning.evidence import BATCHES, gain_of
from ...planning.learner import Learner, Pilot
from ...planning.pixel_estimates import PixelEstimates
from ...planning.prediction import Effect, Prediction
from ...planning.verdicts import GUIDES_GROW, is_trial, least
from ...transport.observer import Observers
from ...transport.path_decisions import Roulette
from ...util.stored_arrays import StoredArrays
from .decisions import AdjointRoulette, GuidedDirections, Regions
from .path_records import BYTES_PER_RECORD, PathRecords
from .roulette_trial import BYTES_PER_PATH, RouletteTrial
from .sample_trees import SampleTrees

#: The share of the samples that trees decide in the second pilot, and the shares from which one is
#: chosen once their effects have been measured.
_FIRST_SHARE, _SHARES = 0.6, (0.4, 0.6, 0.8)


class FlightLearner(Protocol):
    """Learns from what is recorded of flights in media."""

    def update(self, pilot: Pilot, regions: Regions, records: PathRecords) -> None:
        """Learns from the records of all pilots; the last one has recorded those from ``first_new``
        on. The next stage guides directions."""


class Guidance(NamedTuple):
    """How to guide, and the effect of that.

    Attributes:
        share: The share of the samples that trees decide.
        bounces: How many directions of a path are guided.
        gain: The relative reduction of variance.
        efficiency: The efficiency, relative to that without a guide.
    """

    share: float
    bounces: int
    gain: float
    efficiency: float


class GuideLearner(Learner):
    """Learns trees of primary samples in the pilots. The second pilot draws from the trees of the
    first one, from which their efficiency is estimated: if it is too low, learning ends there. The
    same samples determine how many bounces to guide, and the share of uniform samples.

    Parameters:
        regions: Makes the regions that have a tree each, from the scout's vertices and normals.
        wants_scout: Does ``regions`` need these vertices?
        bounces: How many directions of a path are guided, at most.
        max_memory: Bytes for records, and for the trees built from them.
        pilot_samples: Samples of all pilots together.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
        always: Guide all ``bounces``, and learn the roulette, also where the pilots show that it
            does not pay?

    Attributes:
        guide (GuidedDirections): What was learned; ``None`` where nothing is guided.
        roulette (Roulette): The roulette of the next stage.
        guidance (Guidance): The last choice; ``None`` before the second pilot has shown a gain.
        trial (RouletteTrial): The measured effect of the roulette of the last pilot; ``None`` where
            none is learned.
        regions (Regions): The regions that have a tree each; ``None`` before :meth:`start`, and if
            no path scatters.
        known (float): The share of all pilots' samples that the last pilot has recorded.
        sample_count (int): How many samples of directions the trees were built from.
    """

    def __init__(
        self,
        regions: Callable[[mi.Point3f, mi.Normal3f], Regions],
        wants_scout: bool,
        bounces: int,
        max_memory: int,
        pilot_samples: int,
        film_size: tuple[int, int],
        always: bool = False,
    ) -> None:
        self.make_regions, self.wants_scout = regions, wants_scout
        self.bounces, self.max_memory, self.pilot_samples = bounces, max_memory, pilot_samples
        self.always = always
        self.guide: GuidedDirections | None = None
        self.regions: Regions | None = None
        self.guidance: Guidance | None = None
        self.roulette, self.trial = Roulette(), None
        self._rr_depth: int | None = None
        self._flights: FlightLearner | None = None
        self._film_size, self._pixels = film_size, PixelEstimates(*film_size)
        self.pixel_count = film_size[0] * film_size[1]
        #: The time of a sample, relative to ``path`` without guides
        self._time = 1.0
        self.sample_count, self.known = 0, 0.0
        self._records: PathRecords | None = None
        self._share, self._summary = _FIRST_SHARE, ""
        self._batches: list[np.ndarray] = []
        self._variances = np.zeros(BATCHES)

    def start(
        self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f
    ) -> GuidedDirections | None:
        self._summary = "no guide: no path scatters"
        if self.wants_scout and dr.width(p) == 0:
            return None
        self.regions = self.make_regions(p, n)
        self._begin_records()
        if not self.wants_scout:
            return None
        # As ``path``, but with the kernel of the pilots that follow
        count = self.regions.tree_count
        if self._rr_depth is not None:
            self.roulette = AdjointRoulette.by_throughput(
                self.regions, count, self.pixel_count
            )
        return GuidedDirections(SampleTrees.uniform(count), self.regions, self.bounces)

    def _begin_records(self) -> None:
        bytes_per_path = self.bounces * BYTES_PER_RECORD
        if self._rr_depth is not None:
            bytes_per_path += BYTES_PER_PATH
        stride = -(-self.pilot_samples * bytes_per_path // self.max_memory)
        if self._rr_depth is not None:
            self.trial = RouletteTrial(stride, self._rr_depth, self._pixels)
        regions = self.regions
        self._records = PathRecords(
            regions.label, self.bounces, stride, self._pixels, regions.gives_directions,
            self._flights is not None,
        )

    def learn_roulette(self, rr_depth: int) -> None:
        """Makes this learner learn a roulette as well, which begins at the depth ``rr_depth``."""
        self._rr_depth = rr_depth

    def learn_flights(self, flights: FlightLearner) -> None:
        """Makes this learner tell another one the regions and what it has recorded of flights."""
        self._flights = flights

    @property
    def can_be_replaced(self) -> bool:
        return not self.always

    @property
    def learns_beside_light_paths(self) -> bool:
        return self.guide is not None and self.guidance is not None

    @property
    def efficiency(self) -> float:
        return self.guidance.efficiency if self.learns_beside_light_paths else 1.0

    @property
    def growth(self) -> float:
        return GUIDES_GROW if self.learns_beside_light_paths else 1.0

    def beside_light_paths(self, time: float) -> GuideLearner:
        # Guides do not change MIS weights, which light paths share
        other = GuideLearner(
            self.make_regions, self.wants_scout, self.bounces, self.max_memory,
            self.pilot_samples, self._film_size, self.always,
        )  # fmt: skip
        other.guide, other._share, other.regions = self.guide, self._share, self.regions
        other._summary, other._time = self._summary, time
        other._begin_records()
        return other

    def start_again(self) -> GuidedDirections | None:
        return self.guide

    @property
    def observer(self) -> Observers:
        observers = () if self._records is None else (self._records, self.trial)
        return Observers([observer for observer in observers if observer is not None])

    # ---- Between the stages ----

    def learn(self, pilot: Pilot) -> GuidedDirections | None:
        records = self._records
        if records is None:
            return self.guide
        records.finish()
        if self.trial is not None:
            self.trial.finish()
        if records.count == 0:
            self._records, self._summary = None, "no guide: no path scatters"
            self.guide, self.roulette = None, Roulette()
            return None
        bounces, share, effect = self.bounces, _FIRST_SHARE, "not measured"
        self.sample_count = records.count
        self.known = records.paths * records.stride / self.pilot_samples
        if self.guide is not None and records.count > records.first_new:
            # A short trial shows whether guiding is hopeless, but not how many bounces to guide
            known = self.known
            gains = self.gains(records)
            bar = least(Prediction(1.0, 1.0, share=known, grows=True), pilot.is_last)
            against_path = self._against_path(gains, bar)
            rays = RAYS_PER_SEGMENT
            rays *= 1 + (records.count - records.first_new) / max(records.paths, 1)
            rays *= self._time
            self.guidance = most_efficient(gains, self.always, *against_path, rays)
            share, bounces, gain, efficiency = self.guidance
            prediction = Prediction(
                1 - gain, 1 / (max(1 - gain, 1e-3) * efficiency), self._error(), known, True
            )
            if is_trial(known, pilot.is_last):
                bounces = self.bounces
            effect = f"about {max(gain, 0):.0%} less variance"
            if not (self.always or pilot.pays(prediction)):
                self.guide, self._records, self.roulette = None, None, Roulette()
                self._summary = f"no guide: with {self.regions}, {effect}"
                return None
        if self._flights is not None:
            self._flights.update(pilot, self.regions, records)
        nodes, roots, below = self.regions.build(records)
        trees = SampleTrees(
            nodes.probability,
            nodes.child,
            nodes.is_even,
            roots,
            dr.full(mi.Float, share, len(roots)),
            below,
        )
        records.restart_counting()
        if self.trial is not None:
            self.trial.restart()
        self._share = share
        self._summary = (
            f"guide: {self.regions}, {records.count} samples, trees of "
            f"{trees.bytes / 2**20:.1f} MiB for {bounces} bounces that decide {share:.0%} of the "
            f"samples, {effect}"
        )
        self.guide = GuidedDirections(trees, self.regions, bounces)
        if self._rr_depth is not None:
            radiance = self.regions.incident_radiance(records)
            self.roulette = AdjointRoulette(self.regions, radiance, self._pixels.scale())
        return self.guide

    def state(self) -> dict[str, np.ndarray]:
        if self.guide is None:
            return {}
        arrays = {**self.guide.trees.state(), **self.guide.regions.state()}
        return {**arrays, "bounces": np.array(self.guide.bounces)}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> GuidedDirections:
        # Any vertex: these regions are replaced
        regions = self.make_regions(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1))
        regions.restore(state)
        trees, bounces = SampleTrees.of_state(state), state.number("bounces", "iu", 1, 1 << 20)
        state.require(
            trees.count >= regions.tree_count, f"{trees.count} trees for {regions.tree_count} roots"
        )
        self.guide = GuidedDirections(trees, regions, bounces)
        self._summary = f"guide: {regions}, for {bounces} bounces"
        return self.guide

    def finish(self) -> None:
        self._records = None

    def _against_path(
        self, gains: Mapping[float, np.ndarray], bar: float
    ) -> tuple[float, float]:
        """Variance and path length of uniform samples with the roulette of the next stage, relative
        to those of ``path``. Returns to the roulette of ``path`` where the last pilot shows that
        the learned one does not reach ``bar`` times its efficiency."""
        if self.trial is None:
            return 1.0, 1.0
        chosen, path = self.trial.drawn, self.trial.unguided
        by_throughput = self.trial.by_throughput
        if self._rr_depth is not None and not self.always:
            if chosen.efficiency(by_throughput) < bar:
                self._rr_depth, self.roulette, chosen = None, Roulette(), by_throughput
        if path.variance <= 0 or not np.isfinite(path.variance + chosen.variance):
            return 1.0, 1.0
        guided = max(1 - gains[self._share].sum(), 1e-3)
        return chosen.variance / path.variance / guided, chosen.segments / path.segments

    def gains(self, records: PathRecords) -> dict[float, np.ndarray]:
        """The relative reduction of variance by the trees that drew the last samples, under the
        same roulette: for each share of samples that they could decide, by bounce."""
        new = dr.arange(mi.UInt32, records.count - records.first_new)
        new += dr.opaque(mi.UInt32, records.first_new)
        weight, bounce = (dr.gather(type(x), x, new) for x in (records.weight, records.bounce))
        square, self._variances = records.squares(records.value)
        drawn = dr.rcp(weight)
        density = (drawn - (1 - self._share)) / self._share

        place = bounce * BATCHES + dr.gather(mi.UInt32, records.batch, new)

        def by_bounce(x: mi.Float) -> mi.Float64:
            sums = dr.zeros(mi.Float64, records.bounces * BATCHES)
            dr.scatter_add(sums, mi.Float64(x), place)
            return sums

        # The sums of squares with uniform samples, with those drawn, and with other shares
        others = (square * drawn / dr.fma(share, density, 1 - share) for share in _SHARES)
        found = [by_bounce(x) for x in (square * drawn, square, *others)]
        # Evaluated together: each of them alone would be a kernel of its own
        dr.eval(found)
        self._batches = [x.numpy().reshape(-1, BATCHES) for x in found]
        uniform, actual, *others = (x.sum(axis=1) for x in self._batches)
        variance = max(self._variances.sum() + (uniform - actual).sum(), 1e-30)
        gains = {share: (uniform - x) / variance for share, x in zip(_SHARES, others)}
        # Where squares of large numbers overflow, no gain is shown
        return {share: np.nan_to_num(gain, nan=0.0) for share, gain in gains.items()}

    def _error(self) -> float:
        """The standard error of the logarithm of the variance that remains with the guidance."""
        if not self._batches:
            return 0.0
        uniform, actual, *others = self._batches
        other = others[_SHARES.index(self.guidance.share)][: self.guidance.bounces].sum(axis=0)
        before = self._variances + (uniform - actual).sum(axis=0)
        more = uniform[: self.guidance.bounces].sum(axis=0) - other
        return gain_of(np.stack([before - more, more]))[1]

    @property
    def effect(self) -> Effect | None:
        if self.guidance is None:
            return None if self.guide is None else Effect(True)
        variance = max(1 - self.guidance.gain, 1e-3)
        time = 1 / (self.guidance.efficiency * variance)
        about = {"share": self.guidance.share, "bounces": self.guidance.bounces}
        return Effect(self.guide is not None, variance, time, about)

    def __str__(self) -> str:
        return self._summary


def most_efficient(
    gains: Mapping[float, np.ndarray],
    all_bounces: bool = False,
    variance: float = 1.0,
    segments: float = 1.0,
    rays: float = 8.0,
) -> Guidance:
    """The most efficient way to guide.

    Parameters:
        gains: The relative reductions of variance: for each share, by bounce.
        all_bounces: Choose only among candidates that guide all bounces?
        rays: The number of rays per path of ``path``.
        variance, segments: Those of uniform samples under the same roulette, relative to ``path``.
    """
    candidates = []
    for share, by_bounce in gains.items():
        for index, left in enumerate(variance * (1 - np.cumsum(by_bounce))):
            if all_bounces and index < len(by_bounce) - 1:
                continue
            cost = segments + (FIRST_GUIDED + GUIDED * index) / rays
            efficiency = 1 / (max(left, 1e-3) * cost)
            candidates.append(Guidance(share, index + 1, float(1 - left), efficiency))
    return max(candidates, key=lambda guidance: (guidance.efficiency, guidance[:3]))
