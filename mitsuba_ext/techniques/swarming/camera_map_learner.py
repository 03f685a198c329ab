"""Learns maps of the numbers that make a camera ray: time, point of the aperture, wavelength."""

from __future__ import annotations

import mitsuba as mi

from .map_learner import MapLearner
from .mapped_numbers import MappedNumbers
from .tile_counts import Choices


class CameraMapLearner(MapLearner):
    """Learns the maps of :class:`MappedNumbers`, which is its ``decision``."""

    def __init__(self, name: str, decision: MappedNumbers, width: int, height: int, **how) -> None:
        super().__init__(name, decision, width, height, decision.cells, **how)

    def drawn(self) -> tuple[mi.UInt32, mi.Float]:
        return self.decision.drawn

    def choices(self, radiance: mi.Float) -> Choices:
        cell, density = self.last_drawn
        return Choices(mi.UInt32(0), cell, density, radiance, mi.Bool(True))

    def stop(self) -> None:
        super().stop()
        self.decision.drawn = None
