"""Records how the choice of lights contributes to the variance of the image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.costs import SEGMENT, SHADOW, TABLE
from ...planning.evidence import BATCHES, PathSums, gain_of
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...scene.lights.choice import Choice
from ...transport.mis import power_heuristic
from ...transport.observer import Observer
from ...util.arrays import add_own

#: The number of first vertices of a path whose connections are recorded, and about the most paths
#: of a pass that are recorded.
_VERTICES, _MOST_PATHS = 6, 1 << 18


class ConnectionRecords(Observer):
    """Records the contributions of connections that were chosen from a light table, and of
    scattered rays that hit lights which connections could have found: through MIS weights, the
    choice of lights changes both.

    Parameters:
        scene: The scene.
        pixels: Receives the radiance of the paths.
        rows: Number of rows of the table.
        as_path: The probability of each cell in Mitsuba's choice of lights.

    Attributes:
        samples (int): Paths of the last pilot, those that are not recorded included.
        row_squares (mi.Float64): For each row, the sum of the squared contributions that its
            connections would make with Mitsuba's choice, weighted by pixel; shape [rows]. ``None``
            after :meth:`restart`: only the first pilot predicts from them.
        variance (float): Sum of the squared errors that the paths would have with Mitsuba's choice,
            weighted by pixel.
    """

    def __init__(
        self, scene: mi.Scene, pixels: PixelEstimates, rows: int, as_path: mi.Float
    ) -> None:
        self._scene, self._pixels, self._as_path = scene, pixels, as_path
        self._lanes = 0
        self.restart()
        self.row_squares = dr.zeros(mi.Float64, rows)

    def restart(self) -> None:
        """Discards the records of the last pilot."""
        self.row_squares = None
        self.samples, self.variance, self._paths = 0, 0.0, 0
        self._sums = PathSums(others=3)
        self._batches, self._rays = np.zeros((2, BATCHES)), np.zeros(3)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return (
            self._scene, self._as_path, self._path, self._is_recorded, self._slots, self._row,
            self._square, self._more, self._total, self._counts,
        )  # fmt: skip

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32) -> None:
        self._collect()
        self.samples += lanes
        stride = max(1, lanes // _MOST_PATHS)
        self._lanes = -(-lanes // stride)
        lane = dr.arange(mi.UInt32, lanes)
        stride = dr.opaque(mi.UInt32, stride)
        self._pixel = dr.gather(mi.UInt32, pixel, dr.arange(mi.UInt32, self._lanes) * stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        dr.eval(self._path, self._is_recorded)
        slots = self._lanes * _VERTICES
        self._row, self._square = dr.zeros(mi.UInt32, slots), dr.zeros(mi.Float, slots)
        # By how much the sum of squares of a path would be larger if Mitsuba had chosen
        self._more = dr.zeros(mi.Float, self._lanes)
        self._total = dr.zeros(mi.Float, self._lanes)
        # Connections, shadow rays, and shadow rays if Mitsuba had chosen
        self._counts = [dr.zeros(mi.Float, self._lanes) for _ in range(3)]
        dr.eval(self._row, self._square, self._more, self._total, self._counts)

    def emission(self, path, ds, value, mis, pdf, active) -> None:
        # A number that is not finite would make the whole sum so
        active = active & self._is_recorded & (pdf > 0) & (path.arrival.pdf > 0)
        as_path = self._scene.pdf_emitter_direction(path.arrival.ref, ds, active)
        change = power_heuristic(path.arrival.pdf, as_path)
        change /= power_heuristic(path.arrival.pdf, pdf)
        more = dr.square(brightness(value)) * (dr.square(change) - 1)
        add_own(self._more, more, self._path, active & dr.isfinite(more))

    def connection(
        self, choice: Choice, vertex, ds, contribution, value, pdf, visible, tested
    ) -> None:
        is_traced = tested & self._is_recorded
        as_path = dr.gather(mi.Float, self._as_path, choice.cell, is_traced)
        add_own(self._counts[1], mi.Float(1), self._path, is_traced)
        add_own(self._counts[2], as_path / choice.probability, self._path, is_traced)
        active = visible & self._is_recorded
        ratio = choice.probability / as_path
        change = power_heuristic(ds.pdf / ratio, pdf) / power_heuristic(ds.pdf, pdf)
        square = dr.square(brightness(value))
        as_path = square * ratio * dr.select(ds.delta, 1, dr.square(change))
        active &= dr.isfinite(as_path)
        add_own(self._more, as_path - square, self._path, active)
        active &= vertex.depth < _VERTICES
        slot = vertex.depth * self._slots + self._path
        dr.scatter(self._row, choice.row, slot, active)
        # A vertex may have several connections
        add_own(self._square, as_path, slot, active)

    def vertex(self, vertex, active) -> None:
        add_own(self._counts[0], mi.Float(1), self._path, active & self._is_recorded)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def finish(self) -> None:
        """Ends the observation of a stage."""
        self._collect()
        self._batches, (error, removed, *self._rays) = self._sums.read()
        self.variance = float(error + removed)

    def _collect(self) -> None:
        """Keeps what the last pass has recorded."""
        if self._lanes == 0:
            return
        self._pixels.add(self._pixel, self._total)
        weight, error = self._pixels.importance(self._pixel, self._total)
        more = self._more * weight
        more = dr.select(dr.isfinite(more), more, 0)
        dr.eval(weight, error, more)
        self._sums.add(error, more, *self._counts)
        if self.row_squares is not None:
            self._add_squares(weight)
        self._paths += self._lanes
        self._lanes = 0
        self._row = self._square = self._more = self._total = self._pixel = self._counts = None

    def _add_squares(self, weight: mi.Float) -> None:
        slot = dr.arange(mi.UInt32, len(self._row))
        squares = self._square * dr.gather(mi.Float, weight, slot % self._slots)
        is_known = (squares > 0) & dr.isfinite(squares)
        dr.scatter_add(self.row_squares, mi.Float64(squares), self._row, is_known)
        dr.eval(self.row_squares)

    @property
    def measured(self) -> tuple[float, float]:
        """The relative reduction of variance by the choice of the last pilot, and its error
        (``evidence.py``)."""
        return gain_of(self._batches)

    @property
    def removed(self) -> float:
        """By how much the variance of a path would be larger with Mitsuba's choice, weighted by
        pixel."""
        return float(self._batches[1].sum()) / max(self._paths, 1)

    @property
    def cost(self) -> float:
        """The time of a path with the choice of the last pilot, relative to Mitsuba's choice."""
        return self._cost(self._rays[1])

    @property
    def least_cost(self) -> float:
        """The same, if it needed no more shadow rays than Mitsuba's choice."""
        return self._cost(self._rays[2])

    def _cost(self, shadow: float) -> float:
        connections, _, as_path = self._rays
        if connections == 0:
            return 1 + TABLE / SEGMENT
        # One segment led to each vertex, and one away from the last one
        segments = SEGMENT * (self._paths + connections)
        return (segments + SHADOW * shadow + TABLE * connections) / (segments + SHADOW * as_path)

    def predicted_gain(self, ratio: mi.Float) -> float:
        """The relative reduction of variance by a choice with which the mean squares of the
        connections of each row are ``ratio`` times the ones of Mitsuba's choice; shape [rows]."""
        removed = float(dr.sum(self.row_squares * mi.Float64(1 - ratio))[0])
        return removed / max(self.variance, 1e-30)
