"""Merging: the radiance at the vertices of camera paths, estimated from nearby vertices of light
paths (photons).

Source: I. Georgiev, J. Křivánek, T. Davidovič, P. Slusallek, *Light Transport Simulation with
Vertex Connection and Merging*, ACM Transactions on Graphics 31(6), 2012; I. Georgiev, *Implementing
Vertex Connection and Merging*, technical report, 2012.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.bounds import scene_bounds
from ..transport.bsdfs import eval_bsdf
from ..transport.heroes import Heroes
from ..transport.path_decisions import Subpaths
from ..transport.vertex import Vertex
from .light_vertices import LightVertex, LightVertices, PackedVertices, VertexCache, group_of
from .light_walk import LightWalk
from .partial_sums import PartialSums
from .scattering import geometric_cosine, reverse_density
from .vertex_grid import VertexGrid

#: Vertices merge on surfaces that face about the same way: the least cosine between their normals;
#: and within a flat cylinder: its half height in units of its radius. Light would otherwise leak
#: around corners and through thin walls.
_LEAST_COSINE, _HALF_HEIGHT = 0.7, 0.25

#: So many vertices are found before they are evaluated. Lanes of a kernel search for different
#: times, and all of them wait for the last one. (With 1, pool takes 1.2 times as long; 8 gain
#: nothing.)
_BATCH = 4

#: Light paths that measure how dense vertices are, and how often the radius of that is doubled at
#: most.
_PATHS, _DOUBLINGS = 1 << 16, 8

#: The number of vertices that a disk is to hold. For MIS weights, so many vertices are one sample:
#: they share a camera path, and other techniques often vary less than their densities tell. (With
#: weights that count each vertex, the variance is 1.1 to 1.2 times as large in glass_lamp, pool and
#: caustic; with fewer than a tenth of them, it stays about the same.)
HANDFUL = 8.0

#: With fewer vertices of these paths, nothing is merged; and the largest radius of the first sample
#: of a pixel, in footprints of pixels.
_FEW, WIDEST = 64, 8.0

#: The largest radius in units of the diagonal of the scene: pixels of very small films are wide.
_LARGEST = 0.04


@dataclass
class MergingRadius:
    """The radius of merging. It shrinks from pass to pass, so that bias vanishes, and suits the
    number of light paths of a pass: a disk holds about as many vertices whatever that is. In short
    passes, such a disk would be wide, and its bias would outweigh the noise of all passes together;
    ``widest`` limits the radius by the number of samples so far, in however many passes.

    Source: C. Knaus, M. Zwicker, *Progressive Photon Mapping: A Probabilistic Approach*, ACM
    Transactions on Graphics 30(3), 2011: the squared radius of pass i is proportional to i^(α − 1)
    (in the limit of their Eq. 15).

    Parameters:
        first: The radius of a first pass that has one light path per pixel.
        decay: α, in (0, 1]; 1 for a constant radius.
        pixels: Number of pixels.
        before: Light paths per pixel of passes that other renders have made before.
        widest: The largest radius after one light path per pixel; it shrinks with their number as
            that of passes of one.
    """

    first: float
    decay: float
    pixels: int
    before: int = 0
    widest: float = math.inf
    _passes: int = 0

    def next(self, paths: int, groups: int = 1) -> float:
        """The radius of the next pass, of so many light paths; or of so many groups, of so many
        light paths each, whose vertices are not merged with those of other groups."""
        share = self.pixels / paths
        number = self._passes + 1 + self.before * share
        self._passes += groups
        radius = self.first * (share * number ** (self.decay - 1)) ** 0.5
        return min(radius, self.widest * (number / share) ** ((self.decay - 1) / 2))


def median_footprint(scene: mi.Scene, sensor: mi.Sensor) -> float:
    """The width of a pixel where the camera sees the scene: the median over the film. If rays
    through a grid of places on the film hit nothing, or the sensor does not tell how far pixels are
    apart, a thousandth of the diagonal of the scene."""
    count = 64
    lane = dr.arange(mi.UInt32, count * count)
    position = (mi.Point2f(lane % count, lane // count) + 0.5) / count
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    if ray.has_differentials:
        si = scene.ray_intersect(ray)
        width = dr.norm((ray.o_x + ray.d_x * si.t) - (ray.o + ray.d * si.t))
        found = width.numpy()[si.is_valid().numpy()]
        found = found[np.isfinite(found)]
        if len(found) and np.median(found) > 0:
            return float(np.median(found))
    return scene_diagonal(scene) / 1000


def scene_diagonal(scene: mi.Scene) -> float:
    """The diagonal of the scene's bounds; 1000 if it has no surfaces."""
    bounds = scene_bounds(scene)
    return float(dr.norm(bounds.extents())) if bounds.valid() else 1000.0


def suitable_radius(
    scene: mi.Scene,
    sensor: mi.Sensor,
    light_walk: LightWalk,
    footprint: float,
    pixels: int,
    only_caustic: bool,
) -> float | None:
    """The radius in which a disk holds a handful of the vertices of one light path per pixel, where
    there are vertices: measured by a few light paths. ``None`` if these leave too few vertices.

    Parameters:
        light_walk: Traces the light paths.
        footprint: The width of a pixel where the camera sees the scene.
        only_caustic: Are vertices merged only where light arrives from a delta lobe?
    """
    rounds: list[LightVertices] = []
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), _PATHS)
    # Times and wavelengths are those of rays of the sensor
    numbers = sampler.next_2d()
    rays, _ = sensor.sample_ray_differential(
        sensor.shutter_open() + numbers.x * sensor.shutter_open_time(), numbers.y,
        mi.Point2f(0.5), mi.Point2f(0.5),
    )  # fmt: skip
    light_walk.run(
        scene, sampler, rays.time, rays.wavelengths, dr.full(mi.Bool, True, _PATHS),
        lambda vertices: rounds.append(PackedVertices(vertices)),
    )  # fmt: skip
    if not rounds:
        return None
    vertices = VertexCache(rounds, _PATHS)
    kept = vertices.is_caustic if only_caustic else None
    radius = disk_radius(vertices, kept, HANDFUL * _PATHS / pixels, 2 * footprint)
    if radius is None:
        return None
    return min(radius, _LARGEST * scene_diagonal(scene))


def disk_radius(
    vertices: VertexCache,
    kept: Callable[[mi.UInt32, mi.Bool], mi.Bool] | None,
    count: float,
    least: float,
) -> float | None:
    """The radius in which a disk around a vertex holds ``count`` vertices, on average over the
    vertices. ``None`` if there are too few of them to tell.

    Parameters:
        kept: See :class:`VertexGrid`.
        least: The radius, at least, of the disks that are looked at.
    """
    for doublings in range(_DOUBLINGS):
        radius = least * 2**doublings
        grid = VertexGrid(vertices, dr.opaque(mi.Float, radius), kept)
        if grid.count < _FEW:
            return None
        others = grid.occupancy
        if others > 4:
            break
    # Cubes cut squares of two radii out of a surface
    per_area = max(others, 1e-6) / (4 * radius**2)
    return math.sqrt(count / (math.pi * per_area))


def _pushed(stack: list[mi.UInt32], value: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
    """The stack with ``value`` on top (first). The last element is dropped."""
    return [dr.select(active, new, old) for new, old in zip([value, *stack[:-1]], stack)]


class MergedSubpaths(Subpaths):
    """Adds to each vertex of a camera path what light paths bring to the vertices near it.

    Parameters:
        vertices: The vertices of the light paths, at least one.
        grid: Finds them.
        sums: Computes the MIS weights; ``None`` if merging is the only technique that finds what it
            finds.
        heroes: Joins the wavelengths of two paths.
        max_depth: Longest path in segments.
        paths: Number of light paths that a vertex can be merged with.
        shares_rays: Are vertices merged only with those of paths of the same time and wavelengths?
            ``grid`` then has these groups.
        others: Other techniques at the same vertices; ``None`` if there are none.
    """

    def __init__(
        self,
        vertices: VertexCache,
        grid: VertexGrid,
        sums: PartialSums | None,
        heroes: Heroes,
        max_depth: int,
        paths: int,
        shares_rays: bool = False,
        others: Subpaths | None = None,
    ) -> None:
        self._vertices, self._grid, self._sums, self._others = vertices, grid, sums, others
        self._heroes, self._ctx = heroes, heroes.context()
        self._max_depth, self._shares_rays = dr.opaque(mi.UInt32, max_depth), shares_rays
        # The density of light paths per area, for one vertex in the disk
        count = dr.opaque(mi.Float, paths)
        self._per_vertex = dr.rcp(dr.pi * dr.square(grid.radius) * count)
        dr.make_opaque(self._per_vertex)

    @dr.syntax
    def gather(self, scene, sampler, vertex, active):
        total, shadow_count = mi.Spectrum(0), mi.UInt32(0)
        if dr.hint(self._others is not None, mode="scalar"):
            total, shadow_count = self._others.gather(scene, sampler, vertex, active)
        merges = active & mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
        merged = mi.Spectrum(0)
        state, si = self._grid.begin(), vertex.si
        group = group_of(si.time, si.wavelengths) if self._shares_rays else mi.UInt32(0)
        near = [mi.UInt32(0) for _ in range(_BATCH)]
        while dr.hint(merges, label="merge"):
            count, searches = mi.UInt32(0), mi.Bool(merges)
            while dr.hint(searches, label="search"):
                state, index, found, merges = self._grid.next(state, si.p, searches, group)
                near = _pushed(near, index, found)
                count += dr.select(found, 1, 0)
                searches = merges & (count < _BATCH)
            exists = count > 0
            while dr.hint(exists, label="evaluate"):
                merged += self._merged(vertex, self._vertices.at(near[0], exists), exists)
                near = near[1:] + near[:1]
                count -= 1
                exists = count > 0
        total += merged * vertex.path.β * self._per_vertex
        return total, shadow_count

    def _merged(self, vertex: Vertex, other: LightVertex, active: mi.Bool) -> mi.Spectrum:
        """BSDF · flux of one light path, with the MIS weight."""
        si, far = vertex.si, other.si
        active = active & (vertex.depth + other.depth + 1 <= self._max_depth)
        height = dr.abs(dr.dot(si.n, far.p - si.p))
        if self._shares_rays:
            active &= (far.time == si.time) & dr.all(far.wavelengths == si.wavelengths)
        active &= height < _HALF_HEIGHT * self._grid.radius
        active &= dr.dot(si.n, far.n) > _LEAST_COSINE
        wo = si.to_local(far.to_world(far.wi))
        value, pdf = eval_bsdf(vertex.bsdf, self._ctx, si, wo, active)
        value = si.to_world_mueller(value, -wo, si.wi)
        value = self._heroes.merge(
            vertex.path.hero_is_alone, other.hero_is_alone, value, vertex.bsdf, si, wo
        )
        # Flux arrives per area of the surface; the value holds the shading cosine
        arrives = geometric_cosine(far, far.wi)
        value *= other.β * dr.select(arrives > 0, dr.rcp(arrives), 0)
        if self._sums is not None:
            reverse = reverse_density(self._ctx, vertex.bsdf, si, wo, active)
            value *= self._sums.merging_weight(other.sums, pdf, vertex.path.sums, reverse)
        active &= dr.all(dr.isfinite(value))
        return dr.select(active, value, 0)
