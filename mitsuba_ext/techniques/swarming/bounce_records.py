"""Records the radiance that paths gather after each of their first bounces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: The most records of a pass: of larger passes, only a part of the paths is recorded.
_MOST_RECORDS = 1 << 22


class BounceRecords:
    """For each of the first bounces of the paths of a pass: the chosen cell, its density, and the
    radiance that the path had gathered before.

    Parameters:
        lanes: Paths of the pass.
        bounces: Bounces of a path that are recorded, at most.

    Attributes:
        map, cell, density: For each record, see
            :class:`~mitsuba_ext.techniques.swarming.tile_counts.Choices`. The density is 0 where
            there is none.
        lane: The lane of each record.
    """

    def __init__(self, lanes: int, bounces: int) -> None:
        stride = -(-lanes * bounces // _MOST_RECORDS)
        self._paths, self._bounces = -(-lanes // stride), bounces
        count = self._paths * bounces
        lane = dr.arange(mi.UInt32, lanes)
        wide = dr.opaque(mi.UInt32, stride)
        self._path = lane // wide
        self._is_recorded = self._path * wide == lane
        self._opaque_paths = dr.opaque(mi.UInt32, self._paths)
        self.map, self.cell = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
        self.density, self._before = dr.zeros(mi.Float, count), dr.zeros(mi.Float, count)
        index = dr.arange(mi.UInt32, count)
        self.lane = (index - index // self._opaque_paths * self._opaque_paths) * wide
        dr.eval(self.map, self.cell, self.density, self._before, self.lane)

    def _slot(self, bounce: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        is_recorded = active & self._is_recorded & (bounce < self._bounces)
        return bounce * self._opaque_paths + self._path, is_recorded

    def choose(self, bounce, which, cell, density, active) -> None:
        """Records a choice."""
        slot, active = self._slot(bounce, active)
        dr.scatter(self.map, which, slot, active)
        dr.scatter(self.cell, cell, slot, active)
        dr.scatter(self.density, density, slot, active)

    def before(self, bounce: mi.UInt32, radiance: mi.Float, active: mi.Bool) -> None:
        """Records the radiance that a path has gathered before a bounce."""
        slot, active = self._slot(bounce, active)
        dr.scatter(self._before, radiance, slot, active)

    def after(self, total: mi.Float) -> mi.Float:
        """For each record, the radiance that its path gathered afterwards; ``total`` is that of
        each whole path, by lane."""
        return dr.maximum(dr.gather(mi.Float, total, self.lane) - self._before, 0)

    def next_one(self, values: mi.Float) -> mi.Float:
        """For each record, the value of the next record of its path; 0 where there is none."""
        result, later = [], mi.Float(0)
        for k in reversed(range(self._bounces)):
            result.insert(0, dr.zeros(mi.Float, self._paths) + later)
            later = dr.select(self._part(self.density, k) > 0, self._part(values, k), later)
        return dr.concat(result)

    def products(self, values: mi.Float) -> mi.Float:
        """For each record, the product of the values of its path's records up to this one."""
        result, product = [], mi.Float(1)
        for k in range(self._bounces):
            factor = dr.select(self._part(self.density, k) > 0, self._part(values, k), 1)
            product = product * factor
            result.append(product)
        return dr.concat(result)

    def _part(self, values: mi.Float, bounce: int) -> mi.Float:
        """The values of one bounce."""
        first = dr.opaque(mi.UInt32, bounce * self._paths)
        return dr.gather(mi.Float, values, first + dr.arange(mi.UInt32, self._paths))
