"""Estimates variance and cost with other roulettes, or without a guide."""

from __future__ import annotations

import functools
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...planning.evidence import brightest_kept
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...transport.observer import Observer
from ...transport.path_decisions import LARGEST_PROBABILITY, unguided_throughput
from ...util.arrays import joined

#: The number of bounces that are recorded (later ones count as they were drawn), and about the most
#: paths of a pass, which suffice for the few sums.
_BOUNCES, _MOST_PATHS = 12, 1 << 18

#: Bytes that a path takes.
BYTES_PER_PATH = 4 * (4 * _BOUNCES + 1)


class Outcome(NamedTuple):
    """What a way to draw paths gives.

    Attributes:
        variance: Sum over the paths of their squared errors, weighted by pixel, without the
            brightest paths of each pass (``evidence.py``).
        segments: The number of segments of all paths.
    """

    variance: float
    segments: float

    def efficiency(self, other: Outcome) -> float:
        """The efficiency, relative to ``other``."""
        return other.variance * other.segments / max(self.variance * self.segments, 1e-30)


class RouletteTrial(Observer):
    """Estimates, from the paths that were drawn, the effects of other ways to draw them.

    Let a path gather the radiance ``V_j`` after bounce j, and ``V`` in all. Other densities and
    survival probabilities would multiply ``V_j`` by ``A_j``, and make such paths rarer by the same
    factor. The mean square would then be the mean of V² + Σ (A_j − A_{j−1}) V_j², where A is 1
    before the first bounce.

    Parameters:
        stride: At most one in ``stride`` paths is recorded.
        rr_depth: Depth at which roulette begins.
        pixels: The estimates of the pixels' radiance.

    Attributes:
        drawn: The effect of the paths as they were drawn.
        by_throughput: The effect of the same directions with the roulette of ``path``.
        unguided: The effect of uniform samples with the roulette of ``path``.
    """

    def __init__(self, stride: int, rr_depth: int, pixels: PixelEstimates) -> None:
        self._stride, self._rr_depth, self._pixels = stride, rr_depth, pixels
        self._paths = 0
        self.restart()

    def restart(self) -> None:
        """Sets the effects to zero: they then refer to later paths only."""
        self.drawn = self.by_throughput = self.unguided = Outcome(0.0, 0.0)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return (
            self._path, self._is_recorded, self._slots, self._weight, self._before,
            self._throughput, self._probability, self._total,
        )  # fmt: skip

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32) -> None:
        self.finish()
        stride = max(self._stride, lanes // _MOST_PATHS)
        self._paths = -(-lanes // stride)
        lane = dr.arange(mi.UInt32, lanes)
        stride = dr.opaque(mi.UInt32, stride)
        self._pixel = dr.gather(mi.UInt32, pixel, dr.arange(mi.UInt32, self._paths) * stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        self._slots = dr.opaque(mi.UInt32, self._paths)
        self._weight, self._before, self._throughput, self._probability = (
            dr.zeros(mi.Float, self._paths * _BOUNCES) for _ in range(4)
        )
        self._total = dr.zeros(mi.Float, self._paths)
        dr.eval(
            self._path, self._is_recorded, self._weight, self._before, self._throughput,
            self._probability, self._total,
        )  # fmt: skip

    def direction(self, vertex, sample, weight, L, active) -> None:
        active = active & self._is_recorded & (vertex.depth < _BOUNCES)
        slot = vertex.depth * self._slots + self._path
        dr.scatter(self._weight, mi.Float(weight), slot, active)
        dr.scatter(self._before, brightness(L), slot, active)

    def survival(self, path, probability, active) -> None:
        active = active & self._is_recorded & (path.depth <= _BOUNCES)
        slot = (path.depth - 1) * self._slots + self._path
        dr.scatter(self._throughput, unguided_throughput(path), slot, active)
        dr.scatter(self._probability, probability, slot, active)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def finish(self) -> None:
        """Adds what the last pass has recorded."""
        if self._paths == 0:
            return
        total = dr.select(dr.isfinite(self._total), self._total, 0)
        weight, error = self._pixels.importance(self._pixel, total)
        found = [
            self._other(total, roulette, is_guided)
            for roulette, is_guided in ((False, True), (True, True), (True, False))
        ]
        squares = [error + more * weight for more, _ in found]
        dr.eval(squares, found)
        # The largest square that a path has with any way to draw it
        largest = functools.reduce(dr.maximum, squares)
        is_kept = largest <= brightest_kept(largest)
        columns = [dr.select(is_kept, mi.Float64(x), 0) for x in squares]
        columns += [mi.Float64(segments) for _, segments in found]
        # Evaluated together: each of them alone would be a kernel of its own
        dr.eval(columns)
        sums = joined([dr.sum(x) for x in columns]).numpy().tolist()
        effects = [Outcome(*sums[i::3]) for i in range(3)]
        self.drawn, self.by_throughput, self.unguided = (
            Outcome(*(x + y for x, y in zip(old, new)))
            for old, new in zip((self.drawn, self.by_throughput, self.unguided), effects)
        )
        self._paths = 0
        self._weight = self._before = self._throughput = self._probability = None
        self._total = self._pixel = None

    def _other(
        self, total: mi.Float, by_throughput: bool, is_guided: bool
    ) -> tuple[mi.Float, mi.Float]:
        """The increase of the square of each path with another way to draw it, and its segments."""
        path = dr.arange(mi.UInt32, self._paths)
        factor, throughput, reached = mi.Float(1), mi.Float(1), mi.Float(1)
        more, segments = mi.Float(0), mi.Float(1)
        for bounce in range(_BOUNCES):
            weight, before, unguided, p = (
                dr.gather(mi.Float, x, bounce * self._slots + path)
                for x in (self._weight, self._before, self._throughput, self._probability)
            )
            # Where the BSDF's weight is zero, the path ends
            goes_on = (weight > 0) & (unguided > 0) & (p > 0)
            other = p
            if by_throughput and bounce + 1 >= self._rr_depth:
                other = dr.minimum(unguided * throughput, LARGEST_PROBABILITY)
            ratio, density = p / other, mi.Float(1) if is_guided else weight
            change = dr.select(goes_on, factor * (ratio / density - 1), 0)
            more += change * dr.square(dr.maximum(total - before, 0))
            factor += change
            segments += dr.select(goes_on, reached * density * other, 0)
            reached = dr.select(goes_on, reached * density / ratio, reached)
            throughput = dr.select(goes_on, throughput * ratio, throughput)
        # Ignore squares of large numbers that overflow
        return dr.select(dr.isfinite(more), more, 0), segments
