"""Maps of the numbers that make a camera ray: time, point of the aperture, wavelength.

Source: D. Cline, PhD dissertation, BYU 2007, section 9.2.2 (time and lens), section 9.4 (a map of
wavelengths is proposed).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.numbers import Numbers
from .cells import CellDensities, Cells


class MappedNumbers:
    """Numbers of a camera ray that are warped by the map of their tile. See
    :class:`~mitsuba_ext.rendering.camera_samples.PixelNumbers`.

    Parameters:
        periods: 4 for the number u that chooses the wavelengths u + k/4 of a sample, else 1. A
            spectrum that all four wavelengths find has the period 1/4 in u: the number then has a
            second weight, for such spectra.

    Attributes:
        cells: The cells of the maps.
        maps: The maps; ``None`` for uniform numbers.
        tiles: The tiles of the film, each of which has a map.
        drawn: Cell and density of the last pass, for learners.
    """

    def __init__(self, cells: Cells, periods: int = 1) -> None:
        self.cells, self._periods = cells, periods
        self.maps: CellDensities | None = None
        self.tiles: Any = None
        self.drawn: tuple[mi.UInt32, mi.Float] | None = None

    def draw(self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32) -> tuple[Any, ...]:
        is_plane = self.cells.dimension == 2
        u = list(sampler.next_2d()) if is_plane else [sampler.next_1d()]
        density = weight = mi.Float(1)
        if self.maps is None:
            cell = self.cells.find(u)
        else:
            table = self.tiles.tile(pixel)
            u, density, cell = self.maps.sample(table, u)
            weight = dr.rcp(density)
        everyone = density
        if self._periods > 1 and self.maps is not None:
            everyone = self._mean_density(table, cell)
        self.drawn = cell, everyone
        number = mi.Point2f(*u) if is_plane else u[0]
        if self._periods == 1:
            return number, weight
        return number, weight, dr.rcp(everyone)

    def _mean_density(self, table: mi.UInt32, cell: mi.UInt32) -> mi.Float:
        """The mean of the densities with which each wavelength of the sample is the first."""
        count, step = self.cells.count, self.cells.count // self._periods
        densities = (
            self.maps.density(table, (cell + k * step) % count) for k in range(self._periods)
        )
        return sum(densities) / self._periods
