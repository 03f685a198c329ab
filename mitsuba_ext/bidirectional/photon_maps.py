"""Photon maps, and what a camera path asks of them.

A camera path has three parts. Up to its first *diffuse* vertex (one whose BSDF has a diffuse lobe),
it is a path of Mitsuba's ``path``, with all weights. What light reaches that vertex from mirrors,
glass and glossy surfaces is estimated from the caustics map. All other indirect light is found by
one more segment (final gather), which ends at the next diffuse vertex: the global map tells how
much light leaves it. Each path from a light to the camera belongs to exactly one of these.

Source: H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH course,
2004, section 10.5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.heroes import Heroes
from ..transport.path_decisions import Subpaths
from .light_vertices import LightVertices, PackedVertices, VertexCache
from .light_walk import LightWalk
from .merging import MergedSubpaths, disk_radius
from .photon_history import PhotonHistory
from .photon_phases import BEFORE, is_diffuse
from .vertex_grid import VertexGrid


@dataclass
class PhotonMaps:
    """The photons of a render, and the grids that find them.

    Attributes:
        vertices: The photons: vertices of light paths on diffuse surfaces; ``None`` if there are
            none.
        caustics: Those that have met nothing but surfaces that are not diffuse; ``None`` if there
            are too few.
        gathered: Those of the global map. With a final gather, all photons; without, the indirect
            ones that are not in ``caustics``. ``None`` if there are too few.
    """

    vertices: VertexCache | None = None
    caustics: VertexGrid | None = None
    gathered: VertexGrid | None = None

    @classmethod
    def trace(
        cls,
        scene: mi.Scene,
        light_walk: LightWalk,
        paths: int,
        seed: int,
        final_gather: bool,
        radius_of: Callable[[str, Callable[[float], float | None]], float | None],
        lookup_size: int,
        least: float,
    ) -> PhotonMaps:
        """Traces photons.

        Parameters:
            light_walk: Traces the light paths; see :func:`photon_walk`.
            paths: Number of light paths.
            radius_of: Gives the radius of a map (``global`` or ``caustic``), from its name
                and a function that measures a suitable one; ``None`` if the map is empty.
            lookup_size: Number of photons that an estimate uses, on average.
            least: See :func:`disk_radius`.
        """
        rounds: list[LightVertices] = []
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, (0x9E3779B9 * (seed + 1)) & 0xFFFFFFFF), paths)
        rays = dr.zeros(mi.Ray3f, paths)
        light_walk.run(
            scene, sampler, rays.time, rays.wavelengths, dr.full(mi.Bool, True, paths),
            lambda vertices: rounds.append(PackedVertices(vertices)),
        )  # fmt: skip
        if not rounds:
            return cls()
        vertices = VertexCache(rounds, paths)

        def indirect(index: mi.UInt32, active: mi.Bool) -> mi.Bool:
            return (vertices.depth(index, active) > 1) & ~vertices.is_caustic(index, active)

        grids = []
        for name, kept in (
            ("caustic", vertices.is_caustic), ("global", None if final_gather else indirect)
        ):  # fmt: skip
            radius = radius_of(
                name, lambda kept=kept: disk_radius(vertices, kept, lookup_size, least)
            )
            grids.append(radius and VertexGrid(vertices, dr.opaque(mi.Float, radius), kept))
        return cls(vertices, *grids)

    def subpaths(
        self, grid: VertexGrid | None, scene: mi.Scene, max_depth: int
    ) -> MergedSubpaths | None:
        """Estimates radiance from the photons of one of the grids."""
        if grid is None:
            return None
        return MergedSubpaths(self.vertices, grid, None, Heroes(scene).context(), max_depth)


def photon_walk(light_walk: LightWalk) -> LightWalk:
    """The walk, made to store photons: on diffuse surfaces, with what tells caustics."""
    light_walk.sums = PhotonHistory()
    light_walk.stored_lobes = mi.BSDFFlags.Diffuse
    return light_walk


class PhotonSubpaths(Subpaths):
    """What photons bring to the vertices of a camera path.

    Parameters:
        caustics, gathered: Estimate radiance from the two maps; ``None`` for an empty one.
        final_gather: Is the global map looked up at the end of the last segment? If not, it is
            looked up at the first diffuse vertex.
    """

    def __init__(
        self,
        caustics: MergedSubpaths | None,
        gathered: MergedSubpaths | None,
        final_gather: bool,
    ) -> None:
        self._caustics, self._gathered, self._final = caustics, gathered, final_gather

    def gather(self, scene, sampler, vertex, active):
        active = active & is_diffuse(vertex.bsdf)
        is_first = vertex.path.sums == BEFORE
        total, rays = mi.Spectrum(0), mi.UInt32(0)
        if self._caustics is not None:
            total += self._caustics.gather(scene, sampler, vertex, active & is_first)[0]
        if self._gathered is not None:
            asks = ~is_first if self._final else is_first
            total += self._gathered.gather(scene, sampler, vertex, active & asks)[0]
        return total, rays
