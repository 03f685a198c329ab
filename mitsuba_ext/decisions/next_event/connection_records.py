"""Recording what the connections of paths contribute to the variance of the image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...transport.mis import power_heuristic
from ...transport.observer import Observer
from ..path_importance import brightness, importance
from .light_table import Choice

#: Connections of a path that are recorded, those of its first vertices; and paths of a pass, at
#: most, about.
_VERTICES, _MOST_PATHS = 6, 1 << 18


class ConnectionRecords(Observer):
    """Records connections that were chosen from a light table.

    Parameters:
        rows: Rows of the table.
        as_path: The probabilities, for each cell, with which Mitsuba would choose.

    Attributes:
        samples (int): Paths of the last pilot, those that are not recorded included.
        row_squares (mi.Float64): For each row, the sum of the squares of what its connections would
            bring if Mitsuba had chosen, in the image, weighted by :func:`importance`; shape [rows].
        variance (float): Sum of the squared errors of the paths, weighted so, if Mitsuba had
            chosen.
    """

    def __init__(self, rows: int, as_path: mi.Float) -> None:
        self._as_path, self._rows = as_path, rows
        self._lanes = 0
        self.restart()

    def restart(self) -> None:
        """Forgets the last pilot."""
        self.row_squares = dr.zeros(mi.Float64, self._rows)
        self.samples, self.variance = 0, 0.0
        self._error, self._removed = 0.0, [0.0, 0.0]

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32 | None = None) -> None:
        self._collect()
        self.samples += lanes
        stride = max(1, lanes // _MOST_PATHS)
        self._lanes = -(-lanes // stride)
        lane = dr.arange(mi.UInt32, lanes)
        stride = dr.opaque(mi.UInt32, stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        slots = self._lanes * _VERTICES
        self._row = dr.zeros(mi.UInt32, slots)
        # Squares of what the connections of a vertex bring: as drawn, and as Mitsuba would choose,
        # with its MIS weight and with the one that was used
        self._squares = [dr.zeros(mi.Float, slots) for _ in range(3)]
        self._total = dr.zeros(mi.Float, self._lanes)
        dr.eval(self._row, self._squares, self._total)

    def connection(
        self, choice: Choice, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        active = visible & self._is_recorded & (vertex.depth < _VERTICES)
        slot = vertex.depth * self._slots + self._path
        as_path = dr.gather(mi.Float, self._as_path, choice.cell, active)
        dr.scatter(self._row, choice.row, slot, active)
        square = dr.square(brightness(value))
        ratio = choice.probability / as_path
        mis = power_heuristic(ds.pdf, pdf)
        mis_as_path = power_heuristic(ds.pdf / ratio, pdf)
        change = dr.select(ds.delta, 1, mis_as_path / mis)
        # A vertex may have several connections
        for squares, factor in zip(self._squares, (1, ratio * dr.square(change), ratio)):
            dr.scatter_add(squares, square * factor, slot, active)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def finish(self) -> None:
        """Ends the observation of a stage."""
        self._collect()

    def _collect(self) -> None:
        """Keeps what the last pass has recorded."""
        if self._lanes == 0:
            return
        weight, error = importance(self._total)
        slot = dr.arange(mi.UInt32, len(self._row))
        weight = dr.gather(mi.Float, weight, slot % self._slots)
        weighted = [mi.Float64(squares * weight) for squares in self._squares]
        is_number = dr.isfinite(weighted[0] + weighted[1] + weighted[2])
        actual, *as_path = (dr.select(is_number, squares, 0) for squares in weighted)
        dr.scatter_add(self.row_squares, as_path[0], self._row)
        self._error += float(dr.sum(mi.Float64(error))[0])
        for index, squares in enumerate(as_path):
            self._removed[index] += float(dr.sum(squares - actual)[0])
        self.variance = self._error + self._removed[0]
        self._lanes = 0
        self._row = self._squares = self._total = None

    def measured_gain(self) -> float:
        """By how much, relatively, the choice of the last pilot has lowered the variance of the
        image below that with Mitsuba's choice, about.

        A less likely choice has a smaller MIS weight, and what scattering finds in its place a
        larger one. Of that part nothing is recorded: the first bound leaves its variance out, the
        second one leaves all of it to the connections. This is the mean of both."""
        gains = [removed / max(self._error + removed, 1e-30) for removed in self._removed]
        return sum(gains) / 2

    def predicted_gain(self, ratio: mi.Float) -> float:
        """The same for a choice with which the mean squares of the connections of each row become
        ``ratio`` times those with Mitsuba's choice; shape [rows]."""
        removed = float(dr.sum(self.row_squares * mi.Float64(1 - ratio))[0])
        return removed / max(self.variance, 1e-30)
