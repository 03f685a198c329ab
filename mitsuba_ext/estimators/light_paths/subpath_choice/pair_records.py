"""Records the contributions of connections between regions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....planning.pixel_estimates import PixelEstimates, brightness
from ....transport.observer import Observer

#: The number of first vertices of a path whose connections are recorded.
_VERTICES = 6

#: Contributions are clipped to this number of times their pixel's radiance, so that a single one
#: does not dominate.
_LIMIT = 1000.0


class PairRecords(Observer):
    """Records, for each pair of regions, how often vertices of camera paths in the one were
    connected to vertices of light paths in the other, and the squares of their contributions,
    relative to the radiance of the pixel.

    Parameters:
        count: Number of regions.
        pixels: Receives the radiance of the paths.

    Attributes:
        tests (np.ndarray): Number of connections, shape [camera region, light region].
        squares (np.ndarray): The sum of their squared contributions.
        error (float): Sum of the squared errors of the paths, relative to the radiance of the
            pixel.
    """

    def __init__(self, count: int, pixels: PixelEstimates) -> None:
        self._count, self._pixels = count, pixels
        self._lanes = 0
        self.restart()

    def restart(self) -> None:
        """Discards the records of the last pilot."""
        shape = self._count, self._count
        self.tests, self.squares = np.zeros(shape), np.zeros(shape)
        self.error = 0.0

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self._path, self._stride, self._size, self._pair, self._value, self._total

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32) -> None:
        self.finish()
        self._lanes, self._pixel = lanes, mi.UInt32(pixel)
        self._path = dr.arange(mi.UInt32, lanes)
        self._stride = dr.opaque(mi.UInt32, lanes)
        self._size = dr.opaque(mi.UInt32, self._count)
        slots = lanes * _VERTICES
        # Where nothing is recorded: a pair that does not exist
        self._pair = dr.full(mi.UInt32, self._count**2, slots)
        self._value, self._total = dr.zeros(mi.Float, slots), dr.zeros(mi.Float, lanes)
        dr.eval(self._pixel, self._path, self._pair, self._value, self._total)

    def subpath(self, vertex, region, probability, value, active) -> None:
        active = active & (vertex.depth < _VERTICES)
        slot = vertex.depth * self._stride + self._path
        # Of several connections of a vertex, the last one is kept
        pair = vertex.path.history.region * self._size + region
        dr.scatter(self._pair, pair, slot, active)
        dr.scatter(self._value, brightness(value), slot, active)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path)

    # ---- Between passes ----

    def finish(self) -> None:
        """Adds what the last pass has recorded."""
        if self._lanes == 0:
            return
        self._pixels.add(self._pixel, self._total)
        weight, error = self._pixels.importance(self._pixel, self._total)
        slot = dr.arange(mi.UInt32, len(self._pair))
        square = dr.square(self._value) * dr.gather(mi.Float, weight, slot % self._stride)
        square = dr.select(dr.isfinite(square), dr.minimum(square, _LIMIT**2), 0)
        pair, square, size = self._pair.numpy(), square.numpy(), self._count**2
        # NumPy adds in a fixed order: equal seeds make equal sums
        tests = np.bincount(pair, minlength=size + 1)[:size]
        squares = np.bincount(pair, square, size + 1)[:size]
        self.tests += tests.reshape(self._count, -1)
        self.squares += squares.reshape(self._count, -1)
        self.error += float(error.numpy().sum(dtype=np.float64))
        self._lanes = 0
        self._pair = self._value = self._total = self._pixel = self._path = None
