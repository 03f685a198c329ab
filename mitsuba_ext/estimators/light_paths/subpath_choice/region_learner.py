"""Learning the probabilities of the regions from which vertices of light paths are chosen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ....planning.costs import SUBPATH_CHOICE
from ....planning.learner import Learner, Pilot
from ....planning.pixel_estimates import PixelEstimates
from ....planning.prediction import Prediction
from ....scene.regions.nested_regions import NestedRegions
from ....util.arrays import joined
from ....util.stored_arrays import StoredArrays
from .pair_records import PairRecords
from .region_table import RegionTable

#: Share of the choices that depend on the number of vertices alone: each vertex is chosen at least
#: a tenth as often as by a uniform choice.
_DEFENSIVE = 0.1

#: The weight, in connections, of the estimate for a pair of larger regions, as a prior.
_PRIOR = 1.0

#: About the number of connections of the pilots for each pair of regions; and the most regions.
_TESTS, _MOST_REGIONS = 2.0, 768

#: About the number of recorded connections of a path.
_CONNECTIONS = 3


@dataclass
class LightVertexSample:
    """Vertices of some light paths.

    Attributes:
        p, n: Their positions, and normals on the side on which they are connected.
        brightness: Radiance · throughput / density.
        paths: Number of light paths.
    """

    p: mi.Point3f
    n: mi.Normal3f
    brightness: mi.Float
    paths: int


class RegionLearner(Learner):
    """Learns, for each region of vertices of camera paths, the probabilities of the regions of
    vertices of light paths to which they are connected. They become proportional to the root mean
    square of the contributions of connections to the image: BSDFs, distance, visibility, MIS
    weight, and the brightness of the pixel included.

    Where the first pilot shows that a uniform choice is nearly as good, learning ends there.

    Parameters:
        light_vertices: Traces light paths.
        pilot_samples: Samples of all pilots together.
        film_size: Width and height of the film in pixels, with its border where that is sampled.
    """

    wants_scout = True

    def __init__(
        self, light_vertices: Callable[[], LightVertexSample], pilot_samples: int,
        film_size: tuple[int, int],
    ) -> None:  # fmt: skip
        self._light_vertices, self._pilot_samples = light_vertices, pilot_samples
        self._pixels = PixelEstimates(*film_size)
        self._records: PairRecords | None = None
        self._summary = ""

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> RegionTable | None:
        light = self._light_vertices()
        self._summary = "light vertices: there are none to choose"
        if dr.width(p) == 0 or dr.width(light.p) == 0:
            return None
        most = min(_MOST_REGIONS, (self._pilot_samples * _CONNECTIONS / _TESTS) ** 0.5)
        self._regions = regions = NestedRegions(
            joined([p, light.p]), joined([n, light.n]), most=max(1, int(most))
        )
        number = regions.number(light.p, light.n, mi.Bool(True)).numpy()
        count = np.bincount(number, minlength=regions.count)
        power = np.bincount(number, light.brightness.numpy(), regions.count)
        # Half a vertex more in each region: no number is 0
        self._vertices = (count + 0.5) / light.paths
        self._power = (power + 0.5 * power.sum() / count.sum()) / light.paths
        self._uniform = self._vertices / self._vertices.sum()
        self._probability = np.tile(self._uniform, (regions.count, 1))
        # Of all pilots: connections, and the sum of the squares that they would have if the region
        # had been chosen with certainty
        self._tests, self._squares = np.zeros((2, regions.count, regions.count))
        self._records, self._gain = PairRecords(regions.count, self._pixels), None
        return self._table()

    # ---- Observer ----

    def kernel_state(self) -> PairRecords | None:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self._records

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        if self._records is not None:
            self._records.begin(lanes, pixel)

    def subpath(self, *arguments) -> None:
        if self._records is not None:
            self._records.subpath(*arguments)

    def end(self, L: mi.Spectrum) -> None:
        if self._records is not None:
            self._records.end(L)

    # ---- Between the stages ----

    def learn(self, pilot: Pilot) -> RegionTable | None:
        if self._records is None:
            return None
        records = self._records
        records.finish()
        drawn = self._probability
        self._tests += records.tests
        self._squares += records.squares * drawn**2
        self._probability = self._learned()
        if is_first := self._gain is None:
            self._gain = self._predicted_gain(drawn)
        self._summary = (
            f"{self._regions.count} regions of light vertices, at least about "
            f"{max(0.0, self._gain):.0%} less variance"
        )
        prediction = Prediction(1 - self._gain, 1.0, overhead=SUBPATH_CHOICE)
        if is_first and not pilot.pays(prediction):
            self._records = None
            self._summary = f"light vertices uniformly chosen: with {self._summary}"
            return None
        records.restart()
        return self._table()

    def _predicted_gain(self, drawn: np.ndarray) -> float:
        """The relative reduction of variance by the new probabilities, for a pilot with the
        probabilities ``drawn`` and unchanged MIS weights."""
        squares = self._records.squares
        less = (squares * (1 - drawn / self._probability)).sum()
        return less / max(self._records.error, 1e-30)

    def _learned(self) -> np.ndarray:
        """The probabilities learned from all pilots, [camera region, light region]."""
        # Relative to the power of a light region: neighbours are then alike
        tests, squares = self._tests, self._squares / self._power**2
        for axis in (0, 1):
            tests, squares = self._with_smaller(tests, axis), self._with_smaller(squares, axis)
        parent, levels = self._regions.parent, self._regions.levels
        mean = np.zeros_like(tests)
        for i, rows in enumerate(levels):
            for j, columns in enumerate(levels):
                # The prior is the pair in which the smaller region, or both regions of the same
                # size, are replaced by the regions around them
                row = parent[rows] if i >= j else np.arange(rows.start, rows.stop)
                column = parent[columns] if j >= i else np.arange(columns.start, columns.stop)
                prior = _PRIOR * mean[np.ix_(row, column)] if i + j > 0 else 0
                mean[rows, columns] = (squares[rows, columns] + prior) / (
                    tests[rows, columns] + _PRIOR
                )
        likes = self._power * np.sqrt(mean)
        total = likes.sum(axis=1, keepdims=True)
        likes = np.where(total > 0, likes / np.maximum(total, 1e-300), self._uniform)
        return (1 - _DEFENSIVE) * likes + _DEFENSIVE * self._uniform

    def _with_smaller(self, x: np.ndarray, axis: int) -> np.ndarray:
        """Sums over each region and the smaller ones inside of it."""
        x = np.moveaxis(x.copy(), axis, 0)
        for regions in reversed(self._regions.levels[1:]):
            np.add.at(x, self._regions.parent[regions], x[regions])
        return np.moveaxis(x, 0, axis)

    def _table(self) -> RegionTable:
        return RegionTable(self._regions, self._probability, self._vertices, self._power)

    def state(self) -> dict[str, np.ndarray]:
        if self._records is None:
            return {}
        return {
            **self._regions.state(),
            "probability": self._probability,
            "vertices": self._vertices,
            "power": self._power,
        }

    def restore(self, scene: mi.Scene, state: StoredArrays) -> RegionTable:
        self._regions = NestedRegions.of_state(state)
        count, least = self._regions.count, np.finfo(np.float32).tiny
        state.require(count <= _MOST_REGIONS, f"{count} regions")
        self._probability = state.take("probability", "f", (count, count), least, 1)
        self._vertices = state.take("vertices", "f", (count,), least)
        self._power = state.take("power", "f", (count,), 0)
        self._summary = f"{self._regions.count} regions of light vertices"
        return self._table()

    def finish(self) -> None:
        self._records = None

    def __str__(self) -> str:
        return self._summary
