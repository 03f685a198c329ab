"""What paths bring after each of their first bounces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Records of a pass, at most: of larger passes, a part of the paths is recorded.
_MOST_RECORDS = 1 << 22


class BounceRecords:
    """Cells, densities, and radiance before the first bounces of the paths of a pass.

    Parameters:
        lanes: Paths of the pass.
        bounces: Bounces of a path that are recorded, at most.

    Attributes:
        map, cell, density: As :class:`~mitsuba_ext.decisions.swarm.tile_counts.Choices` says, for
            each record; density 0 where there is none.
        lane: Whose record it is.
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
        """Records what a path has brought before a bounce."""
        slot, active = self._slot(bounce, active)
        dr.scatter(self._before, radiance, slot, active)

    def after(self, total: mi.Float) -> mi.Float:
        """What the paths of all records brought afterwards; ``total`` is that of each lane."""
        return dr.maximum(dr.gather(mi.Float, total, self.lane) - self._before, 0)
