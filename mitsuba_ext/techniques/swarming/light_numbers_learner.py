"""Learns maps of the numbers that choose a light and a point on it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...planning.pixel_estimates import brightness
from .map_learner import MapLearner
from .mapped_lights import LightMaps
from .tile_counts import Choices


class LightNumbersLearner(MapLearner):
    """Learns the maps of :class:`LightMaps`, which is its ``decision``."""

    def __init__(self, name: str, decision: LightMaps, width: int, height: int, **how) -> None:
        super().__init__(name, decision, width, height, decision.cells, **how)
        decision.is_recorded = True

    def begin(self, lanes: int, pixel: mi.UInt32 | None) -> None:
        super().begin(lanes, pixel)
        if not self.is_learning:
            return
        self._lane = dr.arange(mi.UInt32, lanes)
        self._cell = dr.zeros(mi.UInt32, lanes)
        self._density, self._value = dr.zeros(mi.Float, lanes), dr.zeros(mi.Float, lanes)
        dr.eval(self._lane, self._cell, self._density, self._value)

    def connection(self, choice, vertex, ds, contribution, value, pdf, visible, tested) -> None:
        if not self.is_learning:
            return
        found = visible & choice.is_mapped
        dr.scatter(self._cell, choice.cell, self._lane, found)
        dr.scatter(self._density, choice.density, self._lane, found)
        dr.scatter(self._value, brightness(value), self._lane, found)

    def choices(self, radiance: mi.Float) -> Choices:
        value = self._value * self.importance
        return Choices(mi.UInt32(0), self._cell, self._density, value, self._density > 0)

    def stop(self) -> None:
        super().stop()
        self.decision.is_recorded = False
        self._lane = self._cell = self._density = self._value = None
