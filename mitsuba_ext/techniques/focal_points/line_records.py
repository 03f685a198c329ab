"""Records the directions of the paths of pilots, and the light that they have found there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.evidence import BATCHES
from ...planning.pixel_estimates import PixelEstimates, brightness
from ...transport.observer import Observer
from ...util.arrays import joined
from .decisions import is_smooth


@dataclass
class Lines:
    """One entry for each direction in which a path found light.

    Attributes:
        p, d: The vertex and the direction.
        pdf: The density with which the direction was sampled.
        value: What the path gained after the vertex, relative to its pixel.
        batch: The batch of paths (``evidence.py``).
    """

    p: mi.Point3f
    d: mi.Vector3f
    pdf: mi.Float
    value: mi.Float
    batch: mi.UInt32


class LineRecords(Observer):
    def __init__(self, bounces: int, stride: int, pixels: PixelEstimates) -> None:
        self.bounces, self.stride, self._pixels = bounces, stride, pixels
        self._lanes = 0
        self._passes: list[Lines] = []
        self.restart()

    def restart(self) -> None:
        self.paths, self.variances = 0, np.zeros(BATCHES)
        self.first_new = self.count

    @property
    def count(self) -> int:
        return dr.width(self._passes[0].pdf) if self._passes else 0

    def kernel_state(self) -> tuple:
        return (
            self._pixel, self._path, self._is_recorded, self._slots, self._p, self._d, self._pdf,
            self._before, self._total,
        )  # fmt: skip

    def begin(self, lanes, pixel) -> None:
        self._collect()
        self._lanes = -(-lanes // self.stride)
        self._pixel = pixel
        lane = dr.arange(mi.UInt32, lanes)
        stride = dr.opaque(mi.UInt32, self.stride)
        self._path = lane // stride
        self._is_recorded = self._path * stride == lane
        slots = self._lanes * self.bounces
        self._p, self._d = dr.zeros(mi.Point3f, slots), dr.zeros(mi.Vector3f, slots)
        self._pdf = dr.zeros(mi.Float, slots)
        self._before = dr.full(mi.Float, dr.inf, slots)
        self._total = dr.zeros(mi.Float, self._lanes)
        self._slots = dr.opaque(mi.UInt32, self._lanes)
        dr.eval(
            self._path, self._is_recorded, self._p, self._d, self._pdf, self._before, self._total
        )

    def direction(self, vertex, sample, weight, L, active) -> None:
        slot, active = self._slot(vertex, active)
        dr.scatter(self._before, brightness(L), slot, active)

    def scattering(self, vertex, bs, active) -> None:
        slot, active = self._slot(vertex, active)
        active &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        dr.scatter(self._p, vertex.si.p, slot, active)
        dr.scatter(self._d, vertex.si.to_world(bs.wo), slot, active)
        dr.scatter(self._pdf, bs.pdf, slot, active)

    def _slot(self, vertex, active):
        active = active & self._is_recorded & (vertex.depth < self.bounces) & is_smooth(vertex)
        return vertex.depth * self._slots + self._path, active

    def end(self, L) -> None:
        dr.scatter(self._total, brightness(L), self._path, self._is_recorded)

    def finish(self) -> None:
        self._collect()
        if self._passes:
            self._passes = [joined(self._passes)]

    @property
    def lines(self) -> Lines | None:
        return self._passes[0] if self._passes else None

    def _collect(self) -> None:
        if self._lanes == 0:
            return
        recorded = dr.arange(mi.UInt32, self._lanes) * dr.opaque(mi.UInt32, self.stride)
        pixel = dr.gather(mi.UInt32, self._pixel, recorded)
        self._pixels.add(pixel, self._total)
        importance, error = self._pixels.importance(pixel, self._total)
        self.paths += self._lanes
        batch = dr.arange(mi.UInt32, self._lanes) % BATCHES
        e, b = error.numpy().astype(np.float64), batch.numpy()
        self.variances += np.bincount(b, np.nan_to_num(e, posinf=0), BATCHES)
        self._lanes = 0
        slot = dr.arange(mi.UInt32, len(self._pdf))
        path = slot % self._slots
        value = dr.gather(mi.Float, self._total, path) - self._before
        slot = dr.compress((value > 0) & (self._pdf > 0) & dr.isfinite(value) & dr.isfinite(self._pdf))
        if len(slot):
            path = slot % self._slots
            value = dr.gather(mi.Float, self._total, path) - dr.gather(mi.Float, self._before, slot)
            lines = Lines(
                dr.gather(mi.Point3f, self._p, slot), dr.gather(mi.Vector3f, self._d, slot),
                dr.gather(mi.Float, self._pdf, slot),
                value * dr.sqrt(dr.gather(mi.Float, importance, path)), path % BATCHES,
            )
            dr.eval(lines)
            self._passes.append(lines)
        self._p = self._d = self._pdf = self._before = self._total = self._pixel = None
