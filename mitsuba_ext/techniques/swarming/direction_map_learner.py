"""Learns maps of directions in the world."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...planning.pixel_estimates import brightness
from .map_learner import MapLearner
from .mapped_scattering import SHARE, MappedScattering
from .tile_counts import Choices


class DirectionMapLearner(MapLearner):
    """Learns the maps of :class:`MappedScattering`, which is its ``decision``."""

    needs_measurement = True

    def __init__(
        self, name: str, decision: MappedScattering, width: int, height: int, **how
    ) -> None:
        super().__init__(name, decision, width, height, decision.cells, **how)
        decision.is_recorded = True

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        super().begin(lanes, pixel)
        if self.is_learning:
            self._lane = dr.arange(mi.UInt32, lanes)
            self._before = dr.full(mi.UInt32, 0x7F800000, lanes)
            dr.eval(self._lane, self._before)

    def direction(self, vertex, sample, weight, L, active) -> None:
        if self.is_learning:
            # The radiance of a path never decreases: its minimum is that before the first bounce.
            # Floats that are not negative have the order of their bits
            bits = dr.reinterpret_array(mi.UInt32, dr.maximum(brightness(L), 0))
            active = active & vertex.is_smooth
            dr.scatter_reduce(dr.ReduceOp.Min, self._before, bits, self._lane, active)

    def choices(self, radiance: mi.Float) -> Choices:
        chosen = self.decision
        before = dr.reinterpret_array(mi.Float, self._before)
        value = dr.maximum(self.total - before, 0) * self.importance
        return Choices(
            mi.UInt32(0), chosen.cell, chosen.density, value, chosen.density > 0,
            share=SHARE, scale=chosen.inverse,
        )  # fmt: skip

    def stop(self) -> None:
        super().stop()
        chosen = self.decision
        chosen.is_recorded = False
        chosen.cell = chosen.density = chosen.inverse = chosen.lane = None
        self._lane = self._before = None
