"""Merging: the radiance at the vertices of camera paths, estimated from nearby vertices of light
paths (photons).

Source: I. Georgiev, J. Křivánek, T. Davidovič, P. Slusallek, *Light Transport Simulation with
Vertex Connection and Merging*, ACM Transactions on Graphics 31(6), 2012; I. Georgiev, *Implementing
Vertex Connection and Merging*, technical report, 2012.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.bounds import scene_bounds
from ....transport.bsdfs import eval_bsdf
from ....transport.heroes import Heroes
from ....transport.path_channels import PathChannels
from ....transport.path_decisions import SceneQuery
from ....transport.path_program import Subpaths
from ....transport.vertex import Vertex
from ..choice.technique_observer import TechniqueObserver
from ..light_vertices import LightVertex, VertexCache, group_of
from ..light_walk import LightWalk
from ..partial_sums import PartialSums
from ..scattering import geometric_cosine, reverse_density
from .vertex_grid import Kept, VertexCounts, VertexGrid

#: Vertices merge if their surfaces face about the same way, and within a flat cylinder. Light would
#: otherwise leak around corners and through thin walls. These are the least cosine between the
#: normals, and half the height of the cylinder in units of its radius.
_LEAST_COSINE, _HALF_HEIGHT = 0.7, 0.25

#: The number of vertices that are found before they are evaluated. Lanes of a kernel take different
#: times to search, and all of them wait for the last one. (With 1, pool takes 1.2 times as long;
#: 8 gain nothing.)
BATCH = 4

#: The number of light paths that measure how dense vertices are, and how often at most the radius
#: of this measurement is doubled.
PILOT_PATHS, DOUBLINGS = 1 << 16, 8

#: The number of photons that a disk should hold. MIS weights count this number of photons as one
#: sample: photons of a disk share a camera path, and other techniques often vary less than their
#: densities suggest. (With weights that count each photon, the variance is 1.1 to 1.2 times as
#: large in glass_lamp, pool and caustic; if they count fewer than a tenth of the photons, it stays
#: about the same.)
PHOTONS_PER_DISK = 8.0

#: The least number of vertices that the measuring light paths must leave: with fewer, nothing is
#: merged. And the largest radius of the first sample of a pixel, in footprints of pixels.
FEW, WIDEST = 64, 8.0

#: The largest radius of the first sample, in units of the diagonal of the scene: pixels of very
#: small films are wide.
LARGEST = 0.04


def widest_radius(scene: mi.Scene, footprint: float) -> float:
    """The largest radius of the first sample of a pixel that is ``footprint`` wide (0 for a
    radiance meter)."""
    largest = LARGEST * scene_diagonal(scene)
    return min(WIDEST * footprint, largest) if footprint > 0 else largest


def median_footprint(scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery) -> float:
    """The width of a pixel where the camera sees the scene: the median over a grid of places on the
    film. It is 0 if all rays of a pixel are the same (a radiance meter), and a thousandth of the
    diagonal of the scene if no ray hits anything."""
    count = 64
    lane = dr.arange(mi.UInt32, count * count)
    position = (mi.Point2f(lane % count, lane // count) + 0.5) / count
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, position, mi.Point2f(0.5))
    pi = query.closest(scene, mi.Ray3f(ray), coherent=True, active=mi.Bool(True))
    if ray.has_differentials:
        width = dr.norm((ray.o_x + ray.d_x * pi.t) - (ray.o + ray.d * pi.t))
        found = width.numpy()[pi.is_valid().numpy()]
        found = found[np.isfinite(found) & (found > 0)]
    else:
        found = _distances_in_pixels(scene, sensor, query, position)
    return float(np.median(found)) if len(found) else scene_diagonal(scene) / 1000


def _distances_in_pixels(
    scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery, position: mi.Point2f
) -> np.ndarray:
    """The distances between the points that two rays of a pixel hit, for the pixel at each place
    ``position``. The two rays use different random numbers."""
    size = mi.Vector2f(sensor.film().crop_size())
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(0, dr.width(position))
    pixel, points, hits = dr.floor(position * size), [], mi.Bool(True)
    for _ in range(2):
        ray, _ = sensor.sample_ray_differential(
            sensor.shutter_open(), 0.5, (pixel + numbers.next_2d()) / size, numbers.next_2d()
        )
        ray = mi.Ray3f(ray)
        pi = query.closest(scene, ray, coherent=False, active=hits)
        points.append(ray(pi.t))
        hits &= pi.is_valid()
    distance = dr.norm(points[0] - points[1]).numpy()
    return distance[np.broadcast_to(hits.numpy(), distance.shape)]


def scene_diagonal(scene: mi.Scene) -> float:
    """The diagonal of the scene's bounds; 1000 if it has no surfaces."""
    bounds = scene_bounds(scene)
    return float(dr.norm(bounds.extents())) if bounds.valid() else 1000.0


def suitable_radius(
    scene: mi.Scene, vertices: VertexCache, kept: Kept | None, footprint: float, pixels: int
) -> float | None:
    """The radius in which a disk holds ``PHOTONS_PER_DISK`` vertices, with one light path per
    pixel, on average over the vertices. ``None`` if there are too few vertices.

    Parameters:
        vertices: The vertices of a few light paths (:func:`pilot_vertices`).
        kept: Which of them are merged on surfaces; see :class:`VertexGrid`.
        footprint: The width of a pixel where the camera sees the scene.
    """
    least = 2 * footprint or scene_diagonal(scene) / 500
    return disk_radius(vertices, kept, PHOTONS_PER_DISK * PILOT_PATHS / pixels, least)


def pilot_vertices(
    scene: mi.Scene, sensor: mi.Sensor, light_walk: LightWalk
) -> VertexCache | None:
    """The vertices of ``PILOT_PATHS`` light paths; ``None`` if there are none."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), PILOT_PATHS)
    # Times and wavelengths are distributed as in the sensor's rays
    numbers = sampler.next_2d()
    rays, _ = sensor.sample_ray_differential(
        sensor.shutter_open() + numbers.x * sensor.shutter_open_time(), numbers.y,
        mi.Point2f(0.5), mi.Point2f(0.5),
    )  # fmt: skip
    active = dr.full(mi.Bool, True, PILOT_PATHS)
    return light_walk.run(scene, sampler, rays.time, rays.wavelengths, active)[0]


def disk_radius(
    vertices: VertexCache,
    kept: Kept | None,
    count: float,
    least: float,
) -> float | None:
    """The radius in which a disk around a vertex holds ``count`` vertices, on average over the
    vertices. ``None`` if there are too few vertices to measure it.

    Parameters:
        kept: See :class:`VertexGrid`.
        least: The smallest radius of the disks in which vertices are counted.
    """
    found = crowded_radius(vertices, kept, least, lambda counts: counts.occupancy)
    if found is None:
        return None
    radius, others = found
    # Cubes cut squares of two radii out of a surface
    per_area = others / (4 * radius**2)
    return math.sqrt(count / (math.pi * per_area))


def crowded_radius(
    vertices: VertexCache,
    kept: Kept | None,
    least: float,
    occupancy: Callable[[VertexCounts], float],
) -> tuple[float, float] | None:
    """The first of the radii ``least``, 2 · ``least``, … within which vertices have more than 4
    others around them (or the last one), and their number. ``None`` if there are too few vertices.

    Parameters:
        kept: See :class:`VertexGrid`.
        occupancy: The number of others around a vertex.
    """
    for doublings in range(DOUBLINGS):
        radius = least * 2**doublings
        counts = VertexCounts(vertices, dr.opaque(mi.Float, radius), kept)
        if counts.count < FEW:
            return None
        others = occupancy(counts)
        if others > 4:
            break
    return radius, max(others, 1e-6)


def pushed(stack: list[mi.UInt32], value: mi.UInt32, active: mi.Bool) -> list[mi.UInt32]:
    """The stack with ``value`` on top, which is the first element. The last element is dropped."""
    return [dr.select(active, new, old) for new, old in zip([value, *stack[:-1]], stack)]


def disk_area(radius: mi.Float) -> mi.Float:
    """The area of a disk."""
    return dr.pi * dr.square(radius)


class MergedSubpaths(Subpaths):
    """Adds, at each vertex of a camera path, the light that light paths bring to nearby vertices.

    Parameters:
        vertices: The vertices of the light paths, at least one.
        grid: Finds them.
        sums: Computes the MIS weights; ``None`` if no other technique finds the light that merging
            finds.
        heroes: Joins the wavelengths of two paths.
        max_depth: Longest path in segments.
        paths: Number of light paths that a vertex can be merged with.
        shares_rays: Whether vertices are merged only if their paths have the same time and
            wavelengths. ``grid`` then has these groups.
        others: Other techniques at the same vertices; ``None`` if there are none.
        observer: Receives what merging adds.
        channels: Adds it to the channels of light path expressions; ``None`` without any.
    """

    #: The area in which vertices are found, from its radius.
    _measure = staticmethod(disk_area)

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
        observer: TechniqueObserver | None = None,
        channels: PathChannels | None = None,
    ) -> None:
        self._channels = channels
        self._vertices, self._grid, self._sums, self._others = vertices, grid, sums, others
        self._heroes, self._ctx, self._observer = heroes, heroes.context(), observer
        self._max_depth, self._shares_rays = dr.opaque(mi.UInt32, max_depth), shares_rays
        # The density of light paths, for one vertex within the radius
        self._per_vertex = dr.rcp(self._measure(grid.radius) * dr.opaque(mi.Float, paths))

    @dr.syntax
    def gather(self, scene, sampler, vertex, active):
        total, shadow_count = mi.Spectrum(0), mi.UInt32(0)
        if dr.hint(self._others is not None, mode="scalar"):
            total, shadow_count = self._others.gather(scene, sampler, vertex, active)
        merges = active & self._is_merged(vertex)
        flight, merged = self._flight(scene, vertex, merges), mi.Spectrum(0)
        state, si = self._grid.begin(), vertex.si
        group = group_of(si.time, si.wavelengths) if self._shares_rays else mi.UInt32(0)
        near, looked = [mi.UInt32(0) for _ in range(BATCH)], mi.UInt32(0)
        while dr.hint(merges, label="merge"):
            count, searches = mi.UInt32(0), mi.Bool(merges)
            while dr.hint(searches, label="search"):
                state, index, found, merges = self._grid.next(state, si.p, searches, group)
                near = pushed(near, index, found)
                count += dr.select(found, 1, 0)
                looked += 1
                searches = merges & (count < BATCH)
            exists = count > 0
            while dr.hint(exists, label="evaluate"):
                other = self._vertices.at(near[0], exists)
                merged += self._merged(vertex, other, flight, exists)
                near = near[1:] + near[:1]
                count -= 1
                exists = count > 0
        total += merged * vertex.path.β * self._per_vertex
        if dr.hint(self._observer is not None, mode="scalar"):
            self._observer.searched(looked)
        return total, shadow_count

    def _is_merged(self, vertex: Vertex) -> mi.Bool:
        """Whether light is gathered at ``vertex``."""
        return mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)

    def _flight(self, scene: mi.Scene, vertex: Vertex, active: mi.Bool) -> Any:
        """What :meth:`_merged` needs to know of the flight that ends at ``vertex``."""
        return None

    def _merged(
        self, vertex: Vertex, other: LightVertex, flight: Any, active: mi.Bool
    ) -> mi.Spectrum:
        """BSDF · flux of one light path, with the MIS weight."""
        si, far = vertex.si, other.si
        active = active & (vertex.depth + other.depth + 1 <= self._max_depth)
        height = dr.abs(dr.dot(si.n, far.p - si.p))
        if self._shares_rays:
            active &= (far.time == si.time) & dr.all(far.wavelengths == si.wavelengths)
        active &= height < _HALF_HEIGHT * self._grid.radius
        active &= dr.dot(si.n, far.n) > _LEAST_COSINE
        wo = si.to_local(far.to_world(far.wi))
        bsdf_value, pdf = eval_bsdf(vertex.bsdf, self._ctx, si, wo, active)
        value = si.to_world_mueller(bsdf_value, -wo, si.wi)
        value = self._heroes.merge(
            vertex.path.hero_is_alone, other.hero_is_alone, value, vertex.bsdf, si, wo
        )
        # Flux arrives per area of the surface; the value holds the shading cosine
        arrives = geometric_cosine(far, far.wi)
        value *= other.β * dr.select(arrives > 0, dr.rcp(arrives), 0)
        mis, competing = mi.Float(1), None
        if self._sums is not None:
            reverse = reverse_density(self._ctx, vertex.bsdf, si, wo, active)
            ends = other.history, pdf, vertex.path.history, reverse
            mis = self._sums.merging_weight(*ends)
            value *= mis
            if self._sums.splits:
                is_first = other.depth == 1, vertex.depth == 0
                competing = self._sums.competing_with_merging(*ends, is_first)
        active &= dr.all(dr.isfinite(value))
        if self._channels is not None:
            brought = value * vertex.path.β * self._per_vertex
            self._channels.joined(vertex, wo, bsdf_value, other.events, brought, active)
        if self._observer is not None:
            brought = value * vertex.path.β * self._per_vertex
            if self._sums is None:
                self._observer.photon(brought, active)
            else:
                self._observer.found_by(other.lane)
                self._observer.merged(brought, mis, competing, active)
        return dr.select(active, value, 0)
