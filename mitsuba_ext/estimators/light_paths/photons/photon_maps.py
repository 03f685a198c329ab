"""Photon maps, and how a camera path uses them.

A camera path has three parts. Up to its first *diffuse* vertex (one whose BSDF has a diffuse lobe),
it is a path of Mitsuba's ``path``, with all weights. What light reaches that vertex from mirrors,
glass and glossy surfaces is estimated from the caustics map. All other indirect light is found by
one more segment (final gather), which ends at the next diffuse vertex: the global map gives the
light that leaves it. Each path from a light to the camera belongs to exactly one of these parts.

Source: H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH course,
2004, section 10.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.heroes import Heroes
from ....transport.path_program import Subpaths
from ..light_vertices import VertexCache
from ..light_walk import LightWalk
from ..merging.merging import MergedSubpaths, disk_radius, scene_diagonal
from ..merging.vertex_grid import Kept, VertexGrid
from .gathering_paths import BEFORE, is_diffuse
from .photon_history import PhotonProgram

#: The radii of a map: how many, and the ratio of one to the one before. Where the search for a
#: suitable one begins, at most, and the largest one, in units of the diagonal of the scene.
_LEVELS, _STEP, _LEAST, _WIDEST = 4, 2.0, 1e-3, 0.05


@dataclass
class PhotonMap:
    """Photons, in grids of increasing radius. An estimate takes the first grid that holds enough
    photons around its place. It thus needs no list of the nearest photons, and adapts to their
    density.

    Attributes:
        grids: The grids.
        enough: Number of photons, in the cells around a place, that suffice for the smaller radius.
    """

    grids: list[VertexGrid]
    enough: mi.UInt32 | int = 0


@dataclass
class PhotonMaps:
    """The photons of a render, and the grids that find them.

    Attributes:
        vertices: The photons: vertices of light paths on diffuse surfaces; ``None`` if there are
            none.
        caustics: The map of the photons that have met only surfaces that are not diffuse.
        gathered: The global map. With a final gather, all photons; without, the indirect ones that
            are not in ``caustics``.
    """

    vertices: VertexCache | None = None
    caustics: PhotonMap | None = None
    gathered: PhotonMap | None = None

    @classmethod
    def trace(
        cls,
        scene: mi.Scene,
        light_walk: LightWalk,
        paths: int,
        seed: int,
        final_gather: bool,
        radii: tuple[float, float],
        lookup_size: int,
        least: float,
    ) -> PhotonMaps:
        """Traces photons.

        Parameters:
            light_walk: Traces the light paths; see :func:`photon_walk`.
            paths: Number of light paths.
            final_gather: See :class:`PhotonSubpaths`.
            radii: Radii of the maps of caustics and of all light; 0 for a radius that suits the
                photons.
            lookup_size: Number of photons that an estimate should use.
            least: See :func:`disk_radius`; 0 for one that suits the scene.
        """
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, (0x9E3779B9 * (seed + 1)) & 0xFFFFFFFF), paths)
        rays = dr.zeros(mi.Ray3f, paths)
        vertices, _ = light_walk.run(
            scene, sampler, rays.time, rays.wavelengths, dr.full(mi.Bool, True, paths)
        )
        if vertices is None:
            return cls()

        def indirect(index: mi.UInt32, active: mi.Bool) -> mi.Bool:
            return (vertices.depth(index, active) > 1) & ~vertices.is_caustic(index, active)

        diagonal = scene_diagonal(scene)
        # Pixels of small films are wide
        least, widest = min(least or math.inf, _LEAST * diagonal), _WIDEST * diagonal

        def photon_map(given: float, kept: Kept | None) -> PhotonMap | None:
            if given > 0:
                return PhotonMap([VertexGrid(vertices, dr.opaque(mi.Float, given), kept)])
            radius = disk_radius(vertices, kept, lookup_size, least)
            if radius is None:
                return None
            wider = [radius * _STEP**k for k in range(1, _LEVELS)]
            grids = [
                VertexGrid(vertices, dr.opaque(mi.Float, r), kept)
                for r in (radius, *(r for r in wider if r < widest))
            ]
            return PhotonMap(grids, dr.opaque(mi.UInt32, lookup_size))

        caustics = photon_map(radii[0], vertices.is_caustic)
        return cls(vertices, caustics, photon_map(radii[1], None if final_gather else indirect))

    def estimates(self, scene: mi.Scene, max_depth: int) -> list[PhotonEstimate | None]:
        """Estimates of radiance from the map of caustics and the global one."""
        heroes, paths = Heroes(scene), self.vertices.paths if self.vertices else 0
        return [
            m and PhotonEstimate(m, [
                MergedSubpaths(self.vertices, grid, None, heroes, max_depth, paths)
                for grid in m.grids
            ])
            for m in (self.caustics, self.gathered)
        ]  # fmt: skip


def photon_walk(light_walk: LightWalk) -> LightWalk:
    """The walk, changed to store photons on diffuse surfaces; their history marks caustics."""
    light_walk.program = PhotonProgram()
    light_walk.stored_lobes = mi.BSDFFlags.Diffuse
    return light_walk


class PhotonEstimate(Subpaths):
    """Estimates the radiance that a vertex reflects, from one photon map.

    Parameters:
        photon_map: The map.
        levels: Estimates within the radius of each of its grids.
    """

    def __init__(self, photon_map: PhotonMap, levels: list[MergedSubpaths]) -> None:
        self._map, self._levels = photon_map, levels

    def gather(self, scene, sampler, vertex, active):
        total, rest, p = mi.Spectrum(0), active, vertex.si.p
        for grid, level in zip(self._map.grids[:-1], self._levels[:-1]):
            suffices = rest & (grid.crowd(p, rest) >= self._map.enough)
            total += level.gather(scene, sampler, vertex, suffices)[0]
            rest = rest & ~suffices
        return total + self._levels[-1].gather(scene, sampler, vertex, rest)[0], mi.UInt32(0)


class PhotonSubpaths(Subpaths):
    """What photons bring to the vertices of a camera path.

    Parameters:
        caustics, gathered: Estimate radiance from the two maps; ``None`` for an empty one.
        final_gather: Whether the global map is looked up at the end of the last segment. If not, it
            is looked up at the first diffuse vertex.
    """

    def __init__(
        self,
        caustics: PhotonEstimate | None,
        gathered: PhotonEstimate | None,
        final_gather: bool,
    ) -> None:
        self._caustics, self._gathered, self._final = caustics, gathered, final_gather

    def gather(self, scene, sampler, vertex, active):
        active = active & is_diffuse(vertex.bsdf)
        is_first = vertex.path.history == BEFORE
        total, rays = mi.Spectrum(0), mi.UInt32(0)
        if self._caustics is not None:
            total += self._caustics.gather(scene, sampler, vertex, active & is_first)[0]
        if self._gathered is not None:
            asks = ~is_first if self._final else is_first
            total += self._gathered.gather(scene, sampler, vertex, active & asks)[0]
        return total, rays
