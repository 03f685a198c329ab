"""Where a path scatters in a homogeneous medium, by the radiance that it finds there.

The number that chooses the distance of a flight is warped. Uniform numbers choose a distance with
the probability that light gets that far and collides. The best density of a number is therefore
proportional to what the path finds in its place: the radiance that is scattered there or, for
numbers that lead to the surface at the end of the flight, the radiance that leaves the surface. The
numbers that lead to a collision are divided into equal cells, each of which stands for the radiance
in its middle. The warp thus decides whether a path scatters before the surface, and where.

Sources: S. Herholz et al., *Volume Path Guiding Based on Zero-Variance Random Walk Theory*, ACM
Transactions on Graphics 38(3), 2019, section 5.1 (distances in proportion to transmittance times
radiance, by steps along the ray); K. Xu et al., *Volume Scattering Probability Guiding*, ACM
Transactions on Graphics 43(6), 2024 (the probability of scattering). The warp is ours.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.free_flight import Distances
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .regions_with_media import RegionsWithMedia
from .scattered_light import ScatteredLight

#: The number of cells of the numbers that lead to a collision.
_CELLS = 16

#: The share of the numbers that are warped; the others are uniform. So the throughput of a path is
#: at most doubled by each flight.
SHARE = 0.5


class GuidedDistances(Distances):
    """Warps the numbers of a path's first flights.

    Parameters (and attributes):
        light: The radiance that media scatter.
        regions: Finds the region of a surface.
        surfaces: Mean radiance that leaves the surfaces of a region, negative where it is unknown.
            [regions]
        flights: How many flights of a path are guided.
    """

    waits = True

    def __init__(
        self, light: ScatteredLight, regions: RegionsWithMedia, surfaces: mi.Float, flights: int
    ) -> None:
        self.light, self.regions, self.surfaces, self.flights = light, regions, surfaces, flights
        # Opaque: the kernel is the same for all values
        self._flights, self._cells = dr.opaque(mi.UInt32, flights), dr.opaque(mi.UInt32, _CELLS)
        dr.make_opaque(self.surfaces)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.light, self.regions, self.surfaces, self._flights, self._cells

    def begin(self, rays) -> Any:
        return super().begin(rays), mi.UInt32(0)

    def draw(self, state, sampler, rays, active):
        used, count = state
        u, used = super().draw(used, sampler, rays, active)
        return u, (used, count + dr.select(active, mi.UInt32(1), 0))

    def is_late(self, state):
        used, count = state
        # The number of a camera ray has a density of its own
        first = mi.UInt32(1 if used is None else 2)
        return (count >= first) & (count <= self._flights)

    def warp(self, u, ray, si, σ, σ_s, active):
        # A branch, so that flights that are not guided cost nothing
        return dr.if_stmt(
            (u, ray.o, ray.d, ray.maxt, si, σ, σ_s),
            active & (σ > 0),
            self._warp,
            lambda u, o, d, end, si, σ, σ_s: (si.t, mi.Bool(False), mi.Float(1)),
        )

    def _warp(self, u, o, d, end, si, σ, σ_s):
        # Camera rays end at the far clip plane
        end = dr.minimum(si.t, end)
        # The probability of a collision before that, and the width of a cell
        collides = 1 - dr.select(dr.isfinite(end), dr.exp(-σ * end), 0)
        width = collides / mi.Float(self._cells)
        warps = u < SHARE
        u = dr.select(warps, u / SHARE, (u - SHARE) / (1 - SHARE))
        u = dr.minimum(u, ONE_MINUS_EPSILON)
        # The cell of a uniform number; the last one stands for the surface
        cell = mi.UInt32(dr.minimum(u / dr.maximum(width, 1e-30), mi.Float(self._cells)))
        cell, of_cell, total, v = self._choose(o, d, σ, width, warps, u, cell)
        albedo = σ_s / σ
        of_cell, of_medium = of_cell * albedo, total * albedo / mi.Float(self._cells)
        of_surface = dr.gather(
            mi.Float, self.surfaces, self.regions.label(si, None, mi.Bool(True))
        )
        # Where the surface is unknown, the probability of a collision remains
        is_known = si.is_valid() & (of_surface >= 0)
        of_surface = dr.select(is_known, of_surface, of_medium)
        mean = collides * of_medium + (1 - collides) * of_surface
        warps &= mean > 0
        scattered = collides * of_medium / mean
        passes = v >= scattered
        w = dr.select(passes, (v - scattered) / (1 - scattered), v / scattered)
        number = dr.select(passes, collides + w * (1 - collides), (mi.Float(cell) + w) * width)
        number = dr.minimum(dr.select(warps, number, u), ONE_MINUS_EPSILON)
        scatters = dr.select(warps, ~passes, u < collides)
        density = dr.select(scatters, of_cell, of_surface) / mean
        density = dr.select(mean > 0, density, 1)
        t = dr.select(scatters, dr.minimum(-dr.log(1 - number) / σ, end), si.t)
        return t, scatters, dr.rcp(dr.fma(SHARE, density, 1 - SHARE))

    @dr.syntax
    def _choose(self, o, d, σ, width, warps, u, cell):
        """Chooses a cell in proportion to its radiance where ``warps``, in one pass over the cells;
        elsewhere keeps ``cell``.

        Returns:
            The cell, its radiance, the sum over the cells, and the uniform number that is left of
            ``u`` where ``warps``.
        """
        u, cell = mi.Float(u), mi.UInt32(cell)
        index, total, of_cell = mi.UInt32(0), mi.Float(0), mi.Float(0)
        while index < self._cells:
            x = self.light.at(o - d * (dr.log(1 - (mi.Float(index) + 0.5) * width) / σ))
            total += x
            p = dr.select(total > 0, x / total, 0)
            takes = warps & (u < p)
            is_chosen = takes | (~warps & (cell == index))
            u = dr.select(takes, u / p, dr.select(warps, (u - p) / (1 - p), u))
            u = dr.minimum(u, ONE_MINUS_EPSILON)
            of_cell = dr.select(is_chosen, x, of_cell)
            cell = dr.select(takes, index, cell)
            index += 1
        return cell, of_cell, total, u
