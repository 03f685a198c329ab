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
from ..transport.path_decisions import Roulette, Subpaths, Weights
from ..transport.vertex import Arrival, PathState, Vertex
from .light_vertices import LightVertices, PackedVertices, VertexCache
from .light_walk import LightWalk
from .merging import MergedSubpaths, disk_radius
from .photon_history import PhotonHistory
from .vertex_grid import VertexGrid

#: The parts of a camera path, by what it has left behind: no diffuse vertex; the first one, just
#: now; the first one, and others that are not diffuse; two diffuse vertices.
BEFORE, GATHERS, GATHERS_ON, ENDED = range(4)


def is_diffuse(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Are photons stored on surfaces of this BSDF?"""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)


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


def first_vertex(scene: mi.Scene, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> Vertex:
    """The vertex of a camera path of one segment."""
    arrival = Arrival(mi.Interaction3f(si), mi.Float(1), mi.Bool(True))
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0), arrival, Heroes(scene).begin(),
        mi.UInt32(BEFORE),
    )  # fmt: skip
    return Vertex(si, si.bsdf(ray), path)


class Phases(Weights):
    """The MIS weights of a camera path: those of ``path`` up to its first diffuse vertex, and for
    light that reaches this vertex directly. Photons have brought all other light. The sums of the
    path are the part that it is in (:data:`BEFORE`, …)."""

    def begin(self, ray):
        return mi.UInt32(BEFORE)

    def emission(self, scene, si, ds, path, pdf):
        return dr.select(path.sums <= GATHERS, super().emission(scene, si, ds, path, pdf), 0)

    def connection(self, scene, vertex, ds, pdf, scattering_pdf):
        weight = super().connection(scene, vertex, ds, pdf, scattering_pdf)
        return dr.select(vertex.path.sums == BEFORE, weight, 0)

    def leave(self, vertex, bs):
        phase = vertex.path.sums
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        scatters = is_diffuse(vertex.bsdf) & ~is_delta
        after = dr.select(phase == BEFORE, mi.UInt32(GATHERS), ENDED)
        return dr.select(scatters, after, dr.select(phase == GATHERS, GATHERS_ON, phase))


class EndsWithTheGather(Roulette):
    """Ends a path at the diffuse vertex at which the last segment arrives.

    Parameters:
        roulette: Decides before that, from ``rr_depth`` on.
        rr_depth: See :class:`~mitsuba_ext.transport.walk.Walk`, whose own is 0.
        last: The part of a path in which it ends.
    """

    def __init__(self, roulette: Roulette, rr_depth: int, last: int) -> None:
        self._roulette, self._last = roulette, last
        self._rr_depth = dr.opaque(mi.UInt32, rr_depth)

    def begin(self, sampler, ray, pixel):
        return self._roulette.begin(sampler, ray, pixel)

    def survival(self, state, vertex, path, active):
        survival, state = self._roulette.survival(state, vertex, path, active)
        survival = dr.select(path.depth >= self._rr_depth, survival, 1)
        return dr.select(path.sums >= self._last, 0, survival), state


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
