"""Learns how much light of each cell reaches each row of surfaces.

Sources: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, section 4.2 (=
Guo's thesis, section 3.4.2) for the idea; cells, sides, contributions and the estimators are ours.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...scene.lights.choice import Choice
from ...scene.lights.light_cells import LightCells
from ...scene.lights.weights import unoccluded_weights
from ...scene.regions.surface_voxels import SurfaceRows
from ...transport.observer import Observer
from ...transport.vertex import Vertex
from ...util.spectra import brightness

#: Fixed point of the squared ratios. They are clipped, so that a single one cannot dominate.
_UNIT, _LIMIT = 2.0**20, 16.0

#: The most that one test can add to the sum of squares.
MOST_SQUARED = int(_UNIT * _LIMIT)

#: The weight of the prior, in tests: for visibility, and for the mean square.
_PRIOR_TESTS, _PRIOR_SQUARES = 1.0, 4.0

#: The reflection of a dark diffuse surface, in units of a white one without the factor 1/π.
_DARK = 0.1

#: The number of tests of an entry that is enough: a pilot with more records only a part of them.
#: And the approximate number of tests of a sample.
_ENOUGH_TESTS, _TESTS_PER_SAMPLE = 32, 2

#: Bytes of an entry, at most: the expectation, the counters, the table that is made from them, and
#: temporaries.
BYTES_PER_ENTRY = 128


class LightMap(Observer):
    """Counts, for each row of surfaces and each light cell, the shadow rays, those that are not
    occluded, and their squared contributions. It observes a walk whose next event decision must
    choose from the same rows and cells. Counters are integers, so that the same samples give
    bitwise the same map.

    Parameters:
        scene: The scene to learn.
        rows: The surfaces that are lit.
        cells: The lights.
        samples: Approximate number of samples that will be observed.

    Attributes:
        unoccluded (mi.Float): The contribution of each cell to each row without occlusion; shape
            [rows · cells].
        tests, successes (mi.UInt32): Shadow rays, and how many of them arrived.
        squares (mi.UInt64): Sum of the squared contributions in units of ``unoccluded``.
    """

    def __init__(
        self, scene: mi.Scene, rows: SurfaceRows, cells: LightCells, samples: int = 0
    ) -> None:
        self.rows, self.cells = rows, cells
        self.unoccluded = unoccluded_weights(scene, rows, cells)
        self._count = dr.opaque(mi.UInt32, cells.count)
        entries = rows.count * cells.count
        # Tests in the low half, successes in the high one: one addition counts both
        self._counts = dr.zeros(mi.UInt64, entries)
        self.squares = dr.zeros(mi.UInt64, entries)
        # One in this number of lanes is recorded
        enough = _ENOUGH_TESTS * entries
        self._stride = dr.opaque(mi.UInt32, max(1, samples * _TESTS_PER_SAMPLE // enough))
        self._is_recorded = mi.Bool(True)
        dr.eval(self.unoccluded, self._counts, self.squares)

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32 | None = None) -> None:
        # By a hash: consecutive lanes are the samples of one pixel, and pixels come row by row
        scattered = (dr.arange(mi.UInt32, lanes) * 0x9E3779B9) >> 8
        self._is_recorded = scattered % self._stride == 0
        dr.eval(self._is_recorded)

    def connection(
        self,
        choice: Choice,
        vertex: Vertex,
        ds: mi.DirectionSample3f,
        contribution: mi.Spectrum,
        value: mi.Spectrum,
        pdf: mi.Float,
        visible: mi.Bool,
        tested: mi.Bool,
    ) -> None:
        """Records a shadow ray, whose contribution is ``contribution`` if it is ``visible``."""
        entry = choice.row * self._count + choice.cell
        tested = tested & self._is_recorded
        expected = dr.gather(mi.Float, self.unoccluded, entry, tested)
        known = visible & tested & (expected > 0)
        # The contribution of the cell, without the probability of choosing it
        brought = brightness(contribution) * choice.probability
        square = dr.square(dr.select(known, brought / expected, 0))
        square = dr.select(dr.isfinite(square), dr.minimum(square, _LIMIT), 0)
        dr.scatter_add(
            self._counts, dr.select(visible, mi.UInt64((1 << 32) + 1), 1), entry, tested
        )
        dr.scatter_add(self.squares, mi.UInt64(square * _UNIT), entry, known)

    # ---- What was learned ----

    @property
    def tests(self) -> mi.UInt32:
        return mi.UInt32(self._counts & 0xFFFFFFFF)

    @property
    def successes(self) -> mi.UInt32:
        return mi.UInt32(self._counts >> 32)

    def restore(self, tests: mi.UInt32, successes: mi.UInt32, squares: mi.UInt64) -> None:
        """Takes over the counts of another map with the same rows and cells."""
        self._counts = mi.UInt64(tests) | (mi.UInt64(successes) << 32)
        self.squares = mi.UInt64(squares)
        self.evaluate()

    def evaluate(self) -> None:
        """Ends the observation of a stage."""
        dr.eval(self._counts, self.squares)

    def ratio(self) -> mi.Float:
        """The share of the shadow rays from a row to a cell that arrived, 1 where none was traced;
        shape [rows · cells]."""
        tests = self.tests
        ratio = mi.Float(self.successes) / mi.Float(dr.maximum(tests, 1))
        return dr.select(tests > 0, ratio, 1)

    def visibility(self) -> mi.Float:
        """The probability that a shadow ray from a row to a cell arrives; shape [rows · cells].

        It is the posterior mean of a Beta distribution. Its prior is the estimate for the same cell
        in voxels of twice the size, whose prior is that for the cell in the whole scene, whose
        prior is the mean over all cells.
        """
        count = self.cells.count
        entry = dr.arange(mi.UInt32, self.rows.count * count)
        row = entry // count
        cell = entry - row * count
        tests, successes = (
            mi.Float64(dr.sum(mi.UInt64(n))) for n in (self.tests, self.successes)
        )
        # Half a success in one more test keeps the prior from being 0 or 1
        expected = self._shrunk(cell, count, mi.Float((successes + 0.5) / (tests + 1)))
        near, near_count = self.rows.coarse()
        group = dr.gather(mi.UInt32, near, row) * count + cell
        expected = self._shrunk(group, near_count * count, expected)
        return (mi.Float(self.successes) + _PRIOR_TESTS * expected) / (
            mi.Float(self.tests) + _PRIOR_TESTS
        )

    def _shrunk(self, group: mi.UInt32, group_count: int, expected: mi.Float) -> mi.Float:
        """For each entry, the success rate of its group, with ``expected`` as the prior."""
        sums = dr.zeros(mi.UInt64, group_count)
        dr.scatter_add(sums, self._counts, group)
        counts = dr.gather(mi.UInt64, sums, group)
        tests, successes = mi.Float(counts & 0xFFFFFFFF), mi.Float(counts >> 32)
        return (successes + _PRIOR_TESTS * expected) / (tests + _PRIOR_TESTS)

    def weights(self, target: str) -> mi.Float:
        """The weights of a selection; shape [rows · cells].

        Parameters:
            target: ``visibility`` for the unoccluded contribution times the probability that a
                shadow ray arrives, ``contribution`` for the root mean square of the contribution,
                BSDF and visibility included.
        """
        visibility = self.visibility()
        if target == "visibility":
            return self.unoccluded * visibility
        return self.unoccluded * dr.sqrt(self._square(visibility))

    def _square(self, visibility: mi.Float) -> mi.Float:
        """The mean squared contribution of a shadow ray, in units of ``unoccluded`` squared."""
        count, successes = self.cells.count, mi.UInt64(self.successes)
        cell = dr.arange(mi.UInt32, len(self.squares)) % count
        # The mean square of the shadow rays that arrived, and of one more on a dark surface
        total = mi.Float64(dr.sum(self.squares)) / _UNIT + _DARK**2
        arrived = mi.Float(total / (mi.Float64(dr.sum(successes)) + 1))
        # The same for each cell; sums of integers do not depend on their order
        of_cell, number = dr.zeros(mi.UInt64, count), dr.zeros(mi.UInt64, count)
        dr.scatter_add(of_cell, self.squares, cell)
        dr.scatter_add(number, successes, cell)
        arrived = mi.Float(of_cell) / _UNIT + _PRIOR_SQUARES * arrived
        arrived /= mi.Float(number) + _PRIOR_SQUARES
        expected = visibility * dr.gather(mi.Float, arrived, cell)
        squares = mi.Float(self.squares) / _UNIT
        return (squares + _PRIOR_SQUARES * expected) / (mi.Float(self.tests) + _PRIOR_SQUARES)

    def square_ratios(self, default: mi.Float, other: mi.Float) -> mi.Float:
        """For each row, the mean square of a connection if its cell is chosen with the
        probabilities ``other``, relative to that with ``default``, at most 1; shape [rows], from
        probabilities of shape [rows · cells]."""
        count = self.cells.count
        # Relative to the sum of the row: squares stay finite for lights of any brightness
        row = dr.repeat(dr.block_sum(self.unoccluded, count), count)
        square = dr.square(self.unoccluded / row) * self._square(self.visibility())
        before, after = (
            dr.block_sum(dr.select(p > 0, square / p, 0), count) for p in (default, other)
        )
        ratio = after / before
        return dr.select(dr.isfinite(ratio), dr.minimum(ratio, 1), 1)

    def __str__(self) -> str:
        seen, succeeded = (int(dr.count(n > 0)[0]) for n in (self.tests, self.successes))
        entries = len(self.tests)
        return (
            f"light map: grid {self.rows.resolution}, {self.rows.count} rows, {self.cells.count} "
            f"cells of lights, {entries} entries ({seen} seen, {succeeded} with a success), "
            f"{entries * BYTES_PER_ENTRY / 2**20:.1f} MiB"
        )
