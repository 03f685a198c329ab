"""Choosing light vertices by a table of regions."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.regions.nested_regions import NestedRegions
from ....scene.regions.surface_voxels import lit_normal
from ....transport.light_table import alias_rows
from ....transport.path_decisions import SubpathSelection
from ....util.arrays import from_numpy


class RegionTable(SubpathSelection):
    """Chooses a region with the probabilities of the region of the camera vertex.

    Parameters:
        regions: The regions of camera vertices and light vertices.
        probability: For each region of a camera vertex, the probability of each region of light
            vertices, all positive; shape [regions, regions].
        vertices: The expected number of vertices of a light path in each region, positive.
        power: The expected sum of their brightness, positive; by default, all are equally bright.
    """

    def __init__(
        self,
        regions: NestedRegions,
        probability: np.ndarray,
        vertices: np.ndarray,
        power: np.ndarray | None = None,
    ) -> None:
        self._regions, self.count = regions, regions.count
        self._table = alias_rows(
            from_numpy(mi.Float, probability), self.count, self.count
        )
        self._expected = from_numpy(mi.Float, probability / vertices)
        # Positive also where no light arrives
        power = np.maximum(vertices if power is None else power, 1e-30)
        self._per_brightness = from_numpy(mi.Float, probability / power)
        # Opaque: scenes that differ in it only share their kernels
        self._size = dr.opaque(mi.UInt32, self.count)
        dr.eval(self._expected, self._per_brightness)

    def region(self, si, active):
        return self._regions.number(si.p, lit_normal(si), active)

    def choose(self, sample, region, active):
        chosen = dr.minimum(mi.UInt32(sample.x * mi.Float(self._size)), self._size - 1)
        entry = dr.gather(mi.Vector4f, self._table, region * self._size + chosen, active)
        is_taken = sample.y < entry[0]
        chosen = dr.select(is_taken, chosen, dr.reinterpret_array(mi.UInt32, entry[1]))
        return chosen, dr.select(is_taken, entry[2], entry[3])

    def expected(self, region, chosen, active):
        return dr.gather(mi.Float, self._expected, region * self._size + chosen, active)

    def by_power(self, power):
        entry = dr.arange(mi.UInt32, self.count**2)
        weight = self._per_brightness * dr.gather(mi.Float, power, entry % self._size)
        table = copy.copy(self)
        table._table = alias_rows(weight, self.count, self.count)
        return table
