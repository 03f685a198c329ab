"""Records the primary samples of paths, and the radiance that followed each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.evidence import BATCHES
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...transport.observer import Observer
from ...util.arrays import joined
from .cells import DEPTH, cell_code

#: The most bytes of a record, including the temporaries while trees are built.
BYTES_PER_RECORD = 320


@dataclass
class _Columns:
    """What is recorded of each sample."""

    region: mi.UInt32
    code: mi.UInt32
    history: mi.UInt32
    bounce: mi.UInt32
    value: mi.Float
    weight: mi.Float
    importance: mi.Float
    throughput: mi.Float
    batch: mi.UInt32


class PathRecords(Observer):
    """Records the first bounces of paths.

    Parameters:
        region: Finds the region of a vertex, from its surface interaction, the pixel of each lane,
            and a mask.
        bounces: Number of bounces of a path that are recorded.
        stride: One in ``stride`` paths is recorded.
        pixels: Receives the radiance of the paths.

    Attributes:
        paths (int): How many paths were recorded.
        region, code (mi.UInt32): Of each sample: its region, and the cell of the primary sample.
        history (mi.UInt32): The cells of the path's earlier samples, the last one in the low byte.
        bounce (mi.UInt32): The number of the bounce, 0 for the first.
        throughput (mi.Float): The path's throughput after this bounce, before roulette.
        value (mi.Float): What the path contributed after the bounce, divided by the densities of
            its samples.
        weight (mi.Float): 1 / density of the sample.
        importance (mi.Float): The weight of a squared error in the pixel of the path.
        batch (mi.UInt32): The batch of paths (``evidence.py``).
        variances (numpy.ndarray): Sums over the paths of their squared errors, with this weight;
            shape [batches].
    """

    def __init__(
        self,
        region: Callable[[mi.SurfaceInteraction3f, mi.UInt32, mi.Bool], mi.UInt32],
        bounces: int,
        stride: int,
        pixels: PixelEstimates,
    ) -> None:
        self._region, self.bounces, self.stride = region, bounces, stride
        self._pixels = pixels
        self._lanes = 0
        self._passes: list[_Columns] = []
        self.restart_counting()

    def restart_counting(self) -> None:
        """Makes ``paths``, ``variance`` and ``first_new`` refer to later records only."""
        self.paths, self.variances = 0, np.zeros(BATCHES)
        self.first_new = self.count

    @property
    def variance(self) -> float:
        """The sum of all ``variances``."""
        return float(self.variances.sum())

    @property
    def count(self) -> int:
        """The number of recorded samples, after :meth:`finish`."""
        return len(self.code) if self._passes else 0

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return (
            self._region, self.bounces, self._pixel, self._path, self._is_recorded, self._slots,
            self._keys, self._weights, self._before, self._throughput, self._total,
        )  # fmt: skip

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32) -> None:
        self._collect()
        self._lanes = -(-lanes // self.stride)
        self._pixel = pixel
        lane = dr.arange(mi.UInt32, lanes)
        stride = dr.opaque(mi.UInt32, self.stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        slots = self._lanes * self.bounces
        self._keys, self._total = dr.zeros(mi.UInt32, slots), dr.zeros(mi.Float, self._lanes)
        self._weights, self._before, self._throughput = (
            dr.zeros(mi.Float, slots) for _ in range(3)
        )
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        dr.eval(
            self._path, self._is_recorded, self._keys, self._weights, self._before,
            self._throughput, self._total,
        )  # fmt: skip

    def direction(self, vertex, sample, weight, L, active) -> None:
        active = active & self._is_recorded & (vertex.depth < self.bounces)
        key = (self._region(vertex.si, self._pixel, active) << DEPTH) | cell_code(sample)
        slot = vertex.depth * self._slots + self._path
        dr.scatter(self._keys, key, slot, active)
        dr.scatter(self._weights, mi.Float(weight), slot, active)
        dr.scatter(self._before, brightness(L), slot, active)

    def survival(self, path, probability, active) -> None:
        active = active & self._is_recorded & (path.depth <= self.bounces)
        slot = (path.depth - 1) * self._slots + self._path
        dr.scatter(self._throughput, brightness(path.β), slot, active)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def finish(self) -> None:
        """Ends the observation of a stage."""
        self._collect()
        if not self._passes:
            return
        # All columns together: each part of them is one kernel
        self._passes = [joined(self._passes)]
        for name, column in vars(self._passes[0]).items():
            setattr(self, name, column)

    def _collect(self) -> None:
        """Keeps what the last pass has recorded."""
        if self._lanes == 0:
            return
        recorded = dr.arange(mi.UInt32, self._lanes) * dr.opaque(mi.UInt32, self.stride)
        pixel = dr.gather(mi.UInt32, self._pixel, recorded)
        self._pixels.add(pixel, self._total)
        importance, error = self._pixels.importance(pixel, self._total)
        self.paths += self._lanes
        self.variances += _batch_sums(error)
        slot = dr.compress(self._weights > 0)
        self._lanes = 0
        if len(slot) == 0:
            return
        key, weight, before = (
            dr.gather(type(x), x, slot) for x in (self._keys, self._weights, self._before)
        )
        bounce = slot // self._slots
        path = slot - bounce * self._slots
        value = dr.maximum(dr.gather(mi.Float, self._total, path) - before, 0)
        # Ignore infinite radiance: it would dominate the trees
        value = dr.select(dr.isfinite(value), value, 0)
        history = dr.zeros(mi.UInt32, len(slot))
        for earlier in range(min(self.bounces - 1, 32 // DEPTH)):
            is_earlier = earlier < bounce
            code = dr.gather(mi.UInt32, self._keys, earlier * self._slots + path, is_earlier)
            code &= (1 << DEPTH) - 1
            history = dr.select(is_earlier, (history << DEPTH) | code, history)
        columns = _Columns(
            key >> DEPTH, key & ((1 << DEPTH) - 1), history, bounce, value, weight,
            dr.gather(mi.Float, importance, path), dr.gather(mi.Float, self._throughput, slot),
            path % BATCHES,
        )  # fmt: skip
        dr.eval(columns)
        self._passes.append(columns)
        self._keys = self._weights = self._before = self._throughput = None
        self._total = self._pixel = None


def _batch_sums(x: mi.Float) -> np.ndarray:
    """The sums of ``x`` over the paths of each batch, in a fixed order."""
    length = -(-len(x) // BATCHES)
    index, size = dr.arange(mi.UInt32, BATCHES * length), dr.opaque(mi.UInt32, length)
    path = index % size * BATCHES + index // size
    in_order = dr.gather(mi.Float, x, path, path < dr.opaque(mi.UInt32, len(x)))
    return dr.block_sum(mi.Float64(in_order), length, mode="evaluated").numpy()
