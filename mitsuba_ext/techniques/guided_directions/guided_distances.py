"""Where a path scatters in a homogeneous medium, by the radiance that it finds there.

The number that chooses the distance of a flight is warped. Uniform numbers choose a distance with
the probability that light gets that far and collides. The best density of a number is therefore
proportional to what the path finds in its place: the radiance that is scattered there or, for
numbers that lead to the surface at the end of the flight, the radiance that leaves the surface. The
warp thus decides whether a path scatters before the surface, and where.

The numbers that lead to a collision are divided into equal cells, and the chosen cell is halved
until it is as long as a voxel. The radiance in a part of the ray is the one in a cube of about its
length (:class:`ScatteredLight`). That takes 8 look-ups for the cells and 2 for each half.

A map of the numbers of camera rays (``distance=swarm``) works on top of this: it weighs the numbers
before they are warped.

Sources: S. Herholz et al., *Volume Path Guiding Based on Zero-Variance Random Walk Theory*, ACM
Transactions on Graphics 38(3), 2019, section 5.1 (distances in proportion to transmittance times
radiance, by steps along the ray); K. Xu et al., *Volume Scattering Probability Guiding*, ACM
Transactions on Graphics 43(6), 2024 (the probability of scattering). The warp is ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...transport.free_flight import Distances
from ...util.discrete_sampling import ONE_MINUS_EPSILON
from .regions_with_media import RegionsWithMedia
from .scattered_light import ScatteredLight

#: The number of cells of the numbers that lead to a collision, and how often a cell is halved.
_CELLS, _HALVINGS = 8, 4

#: No number below 1 leads further than this number of mean free paths.
_FARTHEST = 18.0

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
        self._flights = dr.opaque(mi.UInt32, flights)
        dr.make_opaque(self.surfaces)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self.light, self.regions, self.surfaces, self._flights

    def begin(self, rays) -> Any:
        return super().begin(rays), mi.UInt32(0)

    def draw(self, state, sampler, rays, active):
        used, count = state
        u, used = super().draw(used, sampler, rays, active)
        return u, (used, count + dr.select(active, mi.UInt32(1), 0))

    def is_late(self, state):
        _, count = state
        return (count > 0) & (count <= self._flights)

    def warp(self, u, ray, si, σ, σ_s, active):
        # A branch, so that flights that are not guided cost nothing
        return dr.if_stmt(
            (u, ray.o, ray.d, ray.maxt, si, σ, σ_s),
            active & (σ > 0),
            self._warp,
            lambda u, o, d, end, si, σ, σ_s: (si.t, mi.Bool(False), mi.Float(1)),
        )

    def _warp(self, u, o, d, end, si, σ, σ_s):
        # Camera rays end at the far clip plane, and no number leads further than this
        end = dr.minimum(dr.minimum(si.t, end), _FARTHEST / σ)
        # The probability of a collision before that, and the width of a cell
        collides = 1 - dr.exp(-σ * end)
        width = collides * (1 / _CELLS)
        warps = u < SHARE
        u = dr.select(warps, u / SHARE, (u - SHARE) / (1 - SHARE))
        u = dr.minimum(u, ONE_MINUS_EPSILON)
        ray = _Ray(*self.light.box.in_voxels(o, d), -dr.rcp(σ))
        ends = [mi.Float(0), *(ray.distance(k * width) for k in range(1, _CELLS)), end]
        found = [self.light.around(*ray.between(*pair)) for pair in zip(ends, ends[1:])]
        total = sum(found)
        albedo = σ_s / σ
        of_medium = total * albedo * (1 / _CELLS)
        of_surface = dr.gather(
            mi.Float, self.surfaces, self.regions.label(si, None, mi.Bool(True))
        )
        # Where the surface is unknown, the probability of a collision remains
        is_known = si.is_valid() & (of_surface >= 0)
        of_surface = dr.select(is_known, of_surface, of_medium)
        mean = collides * of_medium + (1 - collides) * of_surface
        warps &= mean > 0
        scattered = dr.select(warps, collides * of_medium / mean, collides)
        passes = u >= scattered
        u = dr.select(passes, (u - scattered) / (1 - scattered), u / scattered)
        # The cell: by the radiance in it, or by its width
        place = u * dr.select(warps, total, _CELLS)
        first, near, far = mi.Float(0), ends[0], ends[1]
        of_cell, before, after, start = found[0], mi.Float(0), mi.Float(0), mi.Float(0)
        for k in range(_CELLS):
            size = dr.select(warps, found[k], 1)
            before, after = after, after + size
            takes = (place >= before) & (size > 0)
            first = dr.select(takes, mi.Float(k), first)
            start, of_cell = dr.select(takes, before, start), dr.select(takes, found[k], of_cell)
            near, far = dr.select(takes, ends[k], near), dr.select(takes, ends[k + 1], far)
        inside = (place - start) / dr.select(warps, of_cell, 1)
        inside = dr.clip(inside, 0, ONE_MINUS_EPSILON)
        number, finer = self._descend(
            ray, first * width, width, near, far, inside, warps, ~passes
        )
        density = dr.select(passes, of_surface, of_cell * finer * albedo) / mean
        density = dr.select(mean > 0, density, 1)
        t = dr.minimum(ray.distance(number), end)
        weight = dr.rcp(dr.fma(SHARE, density, 1 - SHARE))
        return dr.select(passes, si.t, t), ~passes, weight

    @dr.syntax
    def _descend(self, ray, first, width, near, far, u, warps, active):
        """Halves a cell until its parts are as small as a voxel.

        Returns:
            A number in the cell, and its density relative to uniform numbers.
        """
        density, active, level = mi.Float(1), mi.Bool(active), mi.UInt32(0)
        first, width, near, far, u = (mi.Float(x) for x in (first, width, near, far, u))
        while active & (ray.between(near, far)[1] > 1) & (level < _HALVINGS):
            width *= 0.5
            middle = ray.distance(first + width)
            of_near = self.light.around(*ray.between(near, middle))
            of_far = self.light.around(*ray.between(middle, far))
            both = of_near + of_far
            p = dr.select(both > 0, of_near / both, 0.5)
            share = dr.select(warps, p, 0.5)
            is_near = u < share
            u = dr.select(is_near, u, u - share) / dr.select(is_near, share, 1 - share)
            u = dr.minimum(u, ONE_MINUS_EPSILON)
            density *= 2 * dr.select(is_near, p, 1 - p)
            first = dr.select(is_near, first, first + width)
            near, far = dr.select(is_near, near, middle), dr.select(is_near, middle, far)
            level += 1
        return dr.fma(u, width, first), density


@dataclass
class _Ray:
    """A ray through a homogeneous medium, in units of voxels.

    Attributes:
        o, d: Its origin, and the way of a unit of distance.
        scale: −1 / extinction.
    """

    o: mi.Point3f
    d: mi.Vector3f
    scale: mi.Float

    def distance(self, number: mi.Float) -> mi.Float:
        """The distance to which a number leads."""
        return dr.log(1 - number) * self.scale

    def between(self, near: mi.Float, far: mi.Float) -> tuple[mi.Point3f, mi.Float]:
        """The point in the middle between two distances, and the length between them."""
        length = (far - near) * dr.max(dr.abs(self.d))
        return dr.fma(self.d, 0.5 * (near + far), self.o), length
