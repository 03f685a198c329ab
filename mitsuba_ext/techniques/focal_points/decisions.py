"""Mixes directions to focal points with samples of the BSDF."""

from __future__ import annotations

from ...scene.regions.nested_regions import NestedRegions
from ...scene.regions.surface_voxels import lit_normal
from ...transport.mixed_scattering import MixedScattering
from .focal_density import FocalDensity


class FocalScattering(MixedScattering):
    """A share of the directions leads to focal points.

    Parameters (and attributes):
        density: The density of directions to focal points, with a row for each region.
        regions: Finds the region of a vertex.
    """

    def __init__(self, density: FocalDensity, regions: NestedRegions) -> None:
        self.density, self.regions = density, regions

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.density, self.regions

    def share(self, state, vertex, active):
        row = self.regions.number(vertex.si.p, lit_normal(vertex.si), active)
        return row, self.density.share(row, active)

    def direction(self, place, vertex, number, point, active):
        return self.density.sample(place, vertex.si.p, number, point, active)

    def densities(self, place, vertex, directions, active):
        return self.density.densities(place, vertex.si.p, directions, active)
