"""Records the primary samples of paths, and the radiance that followed each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.evidence import BATCHES, brightest_kept
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...transport.observer import Observer
from ...util.arrays import joined
from .cells import DEPTH, cell_code

#: The most bytes of a record, including the temporaries while trees are built.
BYTES_PER_RECORD = 328


@dataclass
class Samples:
    """What is recorded of each sample.

    Attributes:
        region, code: Its region, and the cell of the primary sample.
        history: The cells of the path's earlier samples, the last one in the low byte.
        bounce: The number of the bounce, 0 for the first.
        value: What the path contributed after the bounce, divided by the densities of its samples.
        weight: 1 / density of the sample.
        importance: The weight of a squared error in the pixel of the path.
        throughput: The path's throughput after this bounce, before roulette.
        batch: The batch of paths (``evidence.py``).
        measure: The area, in the square of cells, of a unit of primary samples: not 1 where the
            cells are cells of directions. ``None`` where there are no such samples.
        found: What the path contributed from the vertex of the sample on, divided by the densities
            of its samples. This and what follows is ``None`` where no flights are recorded.
        carried: The throughput of the path when it arrived at the vertex.
        flight: 1 / density of the number that chose the distance of the flight to the vertex.
    """

    region: mi.UInt32
    code: mi.UInt32
    history: mi.UInt32
    bounce: mi.UInt32
    value: mi.Float
    weight: mi.Float
    importance: mi.Float
    throughput: mi.Float
    batch: mi.UInt32
    measure: mi.Float | None = None
    found: mi.Float | None = None
    carried: mi.Float | None = None
    flight: mi.Float | None = None

    def chosen(self, chosen: mi.Bool) -> Samples:
        """Some of the samples."""
        index = dr.compress(chosen)
        columns = (getattr(self, field.name) for field in fields(Samples))
        return Samples(*(x if x is None else dr.gather(type(x), x, index) for x in columns))


class PathRecords(Observer):
    """Records the first bounces of paths.

    Parameters:
        region: Finds the region of a vertex, from its surface interaction, the pixel of each lane,
            and a mask.
        bounces: Number of bounces of a path that are recorded.
        stride: One in ``stride`` paths is recorded.
        pixels: Receives the radiance of the paths.
        gives_directions: Whether samples in media are points of directions
            (:class:`~mitsuba_ext.transport.path_decisions.DirectionSamples`).
        flights: Whether flights in media are recorded.

    Attributes:
        paths (int): How many paths were recorded.
        variances (numpy.ndarray): Sums over the paths of their squared errors, weighted by
            ``importance``; shape [batches].
        region, code, …: The columns of :class:`Samples`.
    """

    def __init__(
        self,
        region: Callable[[mi.SurfaceInteraction3f, mi.UInt32, mi.Bool], mi.UInt32],
        bounces: int,
        stride: int,
        pixels: PixelEstimates,
        gives_directions: bool = False,
        flights: bool = False,
    ) -> None:
        self._gives_directions, self._flights = gives_directions, flights
        self._measure = self._carried = self._flight = None
        self._region, self.bounces, self.stride = region, bounces, stride
        self._pixels = pixels
        self._lanes = 0
        self._passes: list[Samples] = []
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
            self._keys, self._weights, self._before, self._throughput, self._total, self._measure,
            self._carried, self._flight,
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
        if self._gives_directions:
            self._measure = dr.full(mi.Float, 1, slots)
        if self._flights:
            self._carried, self._flight = (dr.full(mi.Float, 1, slots) for _ in range(2))
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        dr.eval(
            self._path, self._is_recorded, self._keys, self._weights, self._before,
            self._throughput, self._total, self._measure, self._carried, self._flight,
        )  # fmt: skip

    def direction(self, vertex, sample, weight, L, active) -> None:
        active = active & self._is_recorded & (vertex.depth < self.bounces)
        key = (self._region(vertex.si, self._pixel, active) << DEPTH) | cell_code(sample)
        slot = vertex.depth * self._slots + self._path
        dr.scatter(self._keys, key, slot, active)
        dr.scatter(self._weights, mi.Float(weight), slot, active)
        dr.scatter(self._before, brightness(L), slot, active)
        if self._flights and vertex.medium is not None:
            dr.scatter(self._carried, brightness(vertex.path.β), slot, active)
            if vertex.medium.weight is not None:
                dr.scatter(self._flight, vertex.medium.weight, slot, active)

    def scattering(self, vertex, bs, active) -> None:
        if self._gives_directions and vertex.medium is not None:
            active = active & vertex.medium.scatters & self._is_recorded
            active &= vertex.depth < self.bounces
            slot = vertex.depth * self._slots + self._path
            dr.scatter(self._measure, dr.inv_four_pi / bs.pdf, slot, active & (bs.pdf > 0))

    def survival(self, path, probability, active) -> None:
        active = active & self._is_recorded & (path.depth <= self.bounces)
        slot = (path.depth - 1) * self._slots + self._path
        dr.scatter(self._throughput, brightness(path.β), slot, active)

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def squares(self, value: mi.Float) -> tuple[mi.Float, np.ndarray]:
        """The weighted squares of the last pilot's values (from ``first_new`` on), and
        ``variances``; without the brightest paths (``evidence.py``): one in ``TRIM`` counts no more
        than the next brightest.

        Parameters:
            value: A column of :class:`Samples`: what paths contributed after a place.
        """
        new = dr.arange(mi.UInt32, self.count - self.first_new)
        new += dr.opaque(mi.UInt32, self.first_new)
        value, importance = (dr.gather(mi.Float, x, new) for x in (value, self.importance))
        square = dr.minimum(dr.square(value) * importance, 1e30)
        # The contribution after the first vertex stands for the whole path
        first = dr.compress(dr.gather(mi.UInt32, self.bounce, new) == 0)
        of_paths = dr.gather(mi.Float, square, first)
        most = brightest_kept(of_paths)
        bright = dr.compress(of_paths > most)
        if len(bright) == 0:
            return square, self.variances
        excess = dr.gather(mi.Float, of_paths, bright) - most
        record = dr.gather(mi.UInt32, new, dr.gather(mi.UInt32, first, bright))
        batch = dr.gather(mi.UInt32, self.batch, record)
        excess = np.bincount(batch.numpy(), excess.numpy(), BATCHES)
        return dr.minimum(square, most), self.variances - excess

    def chosen(self, chosen: mi.Bool) -> Samples:
        """Some of the samples, after :meth:`finish`."""
        return self.samples.chosen(chosen)

    @property
    def samples(self) -> Samples:
        """All samples, after :meth:`finish`."""
        return Samples(*(getattr(self, field.name) for field in fields(Samples)))

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
        value = self._after(path, before)
        history = dr.zeros(mi.UInt32, len(slot))
        for earlier in range(min(self.bounces - 1, 32 // DEPTH)):
            is_earlier = earlier < bounce
            code = dr.gather(mi.UInt32, self._keys, earlier * self._slots + path, is_earlier)
            code &= (1 << DEPTH) - 1
            history = dr.select(is_earlier, (history << DEPTH) | code, history)
        columns = Samples(
            key >> DEPTH, key & ((1 << DEPTH) - 1), history, bounce, value, weight,
            dr.gather(mi.Float, importance, path), dr.gather(mi.Float, self._throughput, slot),
            path % BATCHES,
            dr.gather(mi.Float, self._measure, slot) if self._gives_directions else None,
        )  # fmt: skip
        if self._flights:
            earlier = dr.gather(mi.Float, self._before, slot - self._slots, bounce > 0)
            columns.found = self._after(path, earlier)
            columns.carried, columns.flight = (
                dr.gather(mi.Float, x, slot) for x in (self._carried, self._flight)
            )
        dr.eval(columns)
        self._passes.append(columns)
        self._keys = self._weights = self._before = self._throughput = self._measure = None
        self._total = self._pixel = self._carried = self._flight = None

    def _after(self, path: mi.UInt32, before: mi.Float) -> mi.Float:
        """What recorded paths contributed, except the radiance ``before``."""
        value = dr.maximum(dr.gather(mi.Float, self._total, path) - before, 0)
        # Ignore infinite radiance: it would dominate what is learned
        return dr.select(dr.isfinite(value), value, 0)


def _batch_sums(x: mi.Float) -> np.ndarray:
    """The sums of ``x`` over the paths of each batch, in a fixed order."""
    length = -(-len(x) // BATCHES)
    index, size = dr.arange(mi.UInt32, BATCHES * length), dr.opaque(mi.UInt32, length)
    path = index % size * BATCHES + index // size
    in_order = dr.gather(mi.Float, x, path, path < dr.opaque(mi.UInt32, len(x)))
    return dr.block_sum(mi.Float64(in_order), length, mode="evaluated").numpy()
