"""Records the directions of the paths of a pilot, and the light that was found there."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.evidence import BATCHES
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...scene.regions.nested_regions import NestedRegions
from ...scene.regions.surface_voxels import lit_normal
from ...transport.observer import Observer
from ...transport.vertex import Vertex
from ...util.arrays import joined

#: The most paths of a pass that are recorded. Of the paths of a stage, four times as many.
_MOST_PATHS = 1 << 16

#: The number of paths of a pass once nothing is recorded any more (one would be another kernel).
_NO_PATHS = 2


@dataclass
class Lines:
    """An entry for each direction in which a path has found light.

    Attributes:
        p, d: The vertex, and the direction.
        region: The region of the vertex.
        pdf: The density of the direction, for uniform primary samples.
        guided: 1 / density of the primary sample, where directions are guided.
        value: What the path gained after the vertex, relative to the radiance of its pixel.
        path, bounce: The number of the path among those recorded in the stage, and of the bounce.
    """

    p: mi.Point3f
    d: mi.Vector3f
    region: mi.UInt32
    pdf: mi.Float
    guided: mi.Float
    value: mi.Float
    path: mi.UInt32
    bounce: mi.UInt32

    def chosen(self, index: mi.UInt32) -> Lines:
        """Some of the lines."""
        return Lines(*(dr.gather(type(x), x, index) for x in vars(self).values()))


class LineRecords(Observer):
    """Records the first bounces of paths.

    Parameters:
        regions: Finds the region of a vertex.
        bounces: Number of bounces of a path that are recorded.
        pixels: Receives the radiance of the paths.

    Attributes:
        paths (int): How many paths of the stage were recorded.
        variances (numpy.ndarray): Sums over these paths of their squared errors, relative to the
            squared radiance of their pixels; shape [batches]. The batch of a path
            (``evidence.py``) is its number modulo their number.
    """

    def __init__(
        self,
        regions: NestedRegions,
        bounces: int,
        pixels: PixelEstimates,
    ) -> None:
        self._regions, self.bounces, self._pixels = regions, bounces, pixels
        self._lanes, self._is_stopped = 0, False
        self.restart()

    def stop(self) -> None:
        """Records nothing from now on, with the same kernel."""
        self._is_stopped = True
        self.restart()

    def restart(self) -> None:
        """Forgets all records: a stage begins."""
        self._passes: list[Lines] = []
        self.paths, self.variances = 0, np.zeros(BATCHES)

    def lines(self) -> Lines | None:
        """The records of the stage; ``None`` if no path has found light."""
        self._collect()
        return joined(self._passes) if self._passes else None

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return (
            self._regions, self.bounces, self._path, self._is_recorded, self._slots,
            self._p, self._d, self._where, self._pdf, self._guided, self._before, self._total,
        )  # fmt: skip

    # ---- Observer of the walk ----

    def begin(self, lanes: int, pixel: mi.UInt32) -> None:
        self._collect()
        most = min(_MOST_PATHS, max(1, _MOST_PATHS - self.paths // 4))
        self._stride = -(-lanes // most)
        self._lanes, self._pixel = -(-lanes // self._stride), pixel
        lane, stride = dr.arange(mi.UInt32, lanes), dr.opaque(mi.UInt32, self._stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        if self._is_stopped:
            self._lanes, self._is_recorded = _NO_PATHS, dr.zeros(mi.Bool, lanes)
        slots = self._lanes * self.bounces
        self._p, self._d = dr.zeros(mi.Point3f, slots), dr.zeros(mi.Vector3f, slots)
        self._where = dr.zeros(mi.UInt32, slots)
        self._pdf, self._guided = dr.zeros(mi.Float, slots), dr.zeros(mi.Float, slots)
        # What was not recorded has gained nothing
        self._before = dr.full(mi.Float, dr.inf, slots)
        self._total = dr.zeros(mi.Float, self._lanes)
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        dr.eval(
            self._path, self._is_recorded, self._p, self._d, self._where, self._pdf, self._guided,
            self._before, self._total,
        )  # fmt: skip

    def direction(self, vertex, sample, weight, L, active) -> None:
        slot, active = self._slot(vertex, active)
        dr.scatter(self._before, brightness(L), slot, active)
        dr.scatter(self._guided, mi.Float(weight), slot, active)

    def scattering(self, vertex, bs, active) -> None:
        slot, active = self._slot(vertex, active)
        active &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        dr.scatter(self._p, vertex.si.p, slot, active)
        dr.scatter(self._d, vertex.si.to_world(bs.wo), slot, active)
        region = self._regions.number(vertex.si.p, lit_normal(vertex.si), active)
        dr.scatter(self._where, region, slot, active)
        dr.scatter(self._pdf, bs.pdf, slot, active)

    def _slot(self, vertex: Vertex, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        active = active & self._is_recorded & (vertex.depth < self.bounces) & vertex.is_smooth
        return vertex.depth * self._slots + self._path, active

    def end(self, L: mi.Spectrum) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    # ---- Between passes ----

    def _collect(self) -> None:
        """Keeps what the last pass has recorded."""
        if self._lanes == 0 or self._is_stopped:
            return
        recorded = dr.arange(mi.UInt32, self._lanes) * dr.opaque(mi.UInt32, self._stride)
        pixel = dr.gather(mi.UInt32, self._pixel, recorded)
        self._pixels.add(pixel, self._total)
        importance, error = self._pixels.importance(pixel, self._total)
        self.paths += self._lanes
        error = np.nan_to_num(error.numpy().astype(np.float64), posinf=0.0)
        batch = np.arange(self.paths - len(error), self.paths) % BATCHES
        self.variances += np.bincount(batch, error, BATCHES)
        self._lanes = 0
        slot = dr.arange(mi.UInt32, len(self._pdf))
        value = dr.gather(mi.Float, self._total, slot % self._slots) - self._before
        value *= dr.sqrt(dr.gather(mi.Float, importance, slot % self._slots))
        found = (value > 0) & dr.isfinite(value) & (self._pdf > 0) & dr.isfinite(self._pdf)
        dr.eval(value, found)
        slot = dr.compress(found)
        if len(slot):
            bounce = slot // self._slots
            first = dr.opaque(mi.UInt32, self.paths - len(recorded))
            lines = Lines(
                dr.gather(mi.Point3f, self._p, slot), dr.gather(mi.Vector3f, self._d, slot),
                dr.gather(mi.UInt32, self._where, slot), dr.gather(mi.Float, self._pdf, slot),
                dr.gather(mi.Float, self._guided, slot), dr.gather(mi.Float, value, slot),
                first + slot - bounce * self._slots, bounce,
            )  # fmt: skip
            dr.eval(lines)
            self._passes.append(lines)
        self._p = self._d = self._where = self._pdf = self._guided = self._before = None
        self._total = self._pixel = None


def change_of_squares(lines: Lines, ratio: np.ndarray) -> np.ndarray:
    """How much larger the squares of the recorded paths would be with other densities of their
    directions; sums by batch. See :class:`.roulette_trial.RouletteTrial` of guided directions.

    Parameters:
        ratio: The density with which the direction of a line was drawn, divided by the other one.
    """
    path, bounce, square = lines.path.numpy(), lines.bounce.numpy(), lines.value.numpy()
    square = np.square(square, dtype=np.float64)
    factor, change = np.ones(path.max() + 1), np.zeros(BATCHES)
    for number in range(bounce.max() + 1):
        here = np.flatnonzero(bounce == number)
        which = path[here]
        more = factor[which] * (ratio[here] - 1)
        factor[which] += more
        change += np.bincount(which % BATCHES, more * square[here], BATCHES)
    return np.nan_to_num(change, posinf=0.0, neginf=0.0)
