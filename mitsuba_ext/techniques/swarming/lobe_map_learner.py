"""Learns maps of the number that decides between reflection and transmission."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...planning.pixel_estimates import brightness
from .bounce_records import BounceRecords
from .map_learner import MapLearner
from .mapped_lobes import BOUNCES, REFLECTIONS, MappedLobes, path_density
from .tile_counts import Choices


@dataclass
class LobeChoices(Choices):
    """Choices of the bounces of paths, whose densities multiply.

    Attributes:
        records: The choices of the bounces.
    """

    records: BounceRecords | None = None

    def under(self, q: mi.Float) -> mi.Float:
        return path_density(self.records.products(q))


class LobeMapLearner(MapLearner):
    """Learns the maps of :class:`MappedLobes`, which is its ``decision``."""

    #: The gains that are predicted for the maps of single bounces do not add up
    needs_measurement = True

    #: Maps of each bounce: by the number of reflections before it
    reflections = REFLECTIONS

    def __init__(self, name: str, decision: MappedLobes, width: int, height: int, **how) -> None:
        maps = BOUNCES * REFLECTIONS
        super().__init__(name, decision, width, height, decision.cells, maps=maps, **how)
        decision.is_recorded = True

    def direction(self, vertex, sample, weight, L, active) -> None:
        if self.is_learning:
            self.decision.records.before(vertex.depth, brightness(L), active)

    def choices(self, radiance: mi.Float) -> Choices:
        records = self.decision.records
        value = records.after(self.total) * dr.gather(mi.Float, self.importance, records.lane)
        density = path_density(records.products(records.density))
        return LobeChoices(
            records.map, records.cell, density, value, records.density > 0, records.lane,
            later=records.next_one(value), records=records,
        )  # fmt: skip

    def stop(self) -> None:
        super().stop()
        self.decision.is_recorded, self.decision.records = False, None
