"""Learning which directions to choose."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..learning.learner import Learner
from ..learning.path_records import BYTES_PER_RECORD, PathRecords
from ..learning.sample_trees import SampleTrees
from ..learning.surface_regions import SurfaceRegions
from ..learning.tile_regions import TileRegions
from .defaults import DirectionSamples
from .guided_directions import GuidedDirections

#: The share of the samples that trees decide in the second pilot, and from which of these one is
#: chosen for the rest.
_FIRST_SHARE, _SHARES = 0.6, (0.4, 0.6, 0.8)

#: By how much the variance must fall, relatively: what guiding costs in time. And what a bounce
#: must add.
_LEAST_GAIN, _LEAST_OF_BOUNCE = 0.1, 0.01

#: Samples of a region, at least.
_REGION_SAMPLES = 64


class GuideLearner(Learner):
    """Learns trees of primary samples in the pilots. The second pilot shows what the trees of the
    first one are worth: if too little, learning ends there.

    Parameters:
        tile: Edge of the film's tiles that have a tree each; ``None``: regions of surfaces have.
        extent: Width and height of the film.
        bounces: How many directions of a path are guided, at most.
        max_memory: Bytes for what is recorded, and built from it.
        pilot_samples: Samples of all pilots together.
    """

    def __init__(
        self,
        tile: int | None,
        extent: tuple[int, int],
        bounces: int,
        max_memory: int,
        pilot_samples: int,
    ) -> None:
        self.tile, self.extent, self.bounces = tile, extent, bounces
        self.max_memory, self.pilot_samples = max_memory, pilot_samples
        self.wants_scout = tile is None
        self._records: PathRecords | None = None
        self._share, self._summary = _FIRST_SHARE, ""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> dict[str, Any]:
        self._records, self._share = None, None
        self._summary = "no guiding: no path scatters"
        if self.tile is not None:
            self._regions = TileRegions(*self.extent, self.tile)
        elif dr.width(p) > 0:
            width, height = self.extent
            paths = dr.width(p) / 3
            self._regions = SurfaceRegions(
                p, n, max(1, _REGION_SAMPLES * width * height / self.pilot_samples)
            )
        else:
            return {}
        records = self.pilot_samples * self.bounces
        stride = -(-records * BYTES_PER_RECORD // self.max_memory)
        self._records = PathRecords(self._regions.label, self.bounces, stride)
        return {}

    # ---- Observer ----

    def begin(self, lanes, pixel) -> None:
        if self._records is not None:
            self._records.begin(lanes, pixel)

    def direction(self, *arguments) -> None:
        if self._records is not None:
            self._records.direction(*arguments)

    def end(self, L) -> None:
        if self._records is not None:
            self._records.end(L)

    # ---- Between the stages ----

    def learn(self, scene: mi.Scene, is_last: bool) -> dict[str, Any]:
        records = self._records
        if records is None:
            return {}
        records.finish()
        bounces, share = self.bounces, _FIRST_SHARE
        summary = ""
        if self._share is not None:
            gains = self._gains(records)
            share = max(gains, key=lambda s: gains[s].sum())
            gain = gains[share].sum()
            paying = np.flatnonzero(gains[share] > _LEAST_OF_BOUNCE)
            bounces = paying[-1] + 1 if len(paying) else 0
            if gain < _LEAST_GAIN:
                self._records = None
                self._summary = (
                    f"{self._regions}; not used, guiding would lower the variance by only "
                    f"{max(0.0, gain):.0%}"
                )
                return {"directions": DirectionSamples()}
            summary = f", variance about {gain:.0%} lower"
        builder, roots, below = self._regions.build(records)
        share_of_trees = dr.full(mi.Float, share, len(roots))
        trees = SampleTrees(
            builder.probability, builder.child, builder.is_even, roots, share_of_trees, below
        )
        records.restart_counting()
        self._share = share
        self._summary = (
            f"{self._regions}, {len(records.code)} samples, {trees.bytes / 2**20:.1f} MiB of trees, "
            f"{bounces} bounces, a share of {share:g}{summary}"
        )
        if is_last:
            self._records = None
        return {"directions": GuidedDirections(trees, self._regions, bounces)}

    def _gains(self, records: PathRecords) -> dict[float, np.ndarray]:
        """By how much, relatively, the trees that drew the last samples lower the variance, for
        each share and bounce."""
        new = dr.arange(mi.UInt32, len(records.code) - records.first_new)
        new += dr.opaque(mi.UInt32, records.first_new)
        value, weight, importance, bounce = (
            dr.gather(type(x), x, new)
            for x in (records.value, records.weight, records.importance, records.bounce)
        )
        square, drawn = dr.square(value) * importance, dr.rcp(weight)
        density = (drawn - (1 - self._share)) / self._share

        def by_bounce(x: mi.Float) -> np.ndarray:
            sums = dr.zeros(mi.Float64, records.bounces)
            dr.scatter_add(sums, mi.Float64(x), bounce)
            return sums.numpy()

        uniform, actual = by_bounce(square * drawn), by_bounce(square)
        variance = max(records.variance + (uniform - actual).sum(), 1e-30)
        return {
            share: (uniform - by_bounce(square * drawn / dr.fma(share, density, 1 - share)))
            / variance
            for share in _SHARES
        }

    def __str__(self) -> str:
        return self._summary
