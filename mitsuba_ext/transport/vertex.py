"""The state of a random walk at the vertex that it has reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi


@dataclass
class Arrival:
    """How a path reached its vertex.

    Attributes:
        ref: The previous vertex; meaningless at the first one.
        pdf: Solid angle density, at ``ref``, of the direction that led here.
        is_delta: Whether a discrete distribution chose that direction (a mirror, or the sensor). No
            connection could then have found this vertex.
    """

    ref: mi.Interaction3f
    pdf: mi.Float
    is_delta: mi.Bool


@dataclass
class PathState:
    """What a path carries from one vertex to the next.

    Attributes:
        β: Throughput up to the vertex.
        η: Product of the relative indices of refraction.
        sampling_weight: The factor of ``β`` that depends on how the path was sampled, not on what
            it hit: 1 / density of guided primary samples, and 4 where only one of four wavelengths
            is left. Russian roulette divides by it.
        depth: Number of vertices before this one, not counting the sensor.
        arrival: How the path reached the vertex.
        hero_is_alone: Whether only the first of the four wavelengths is left; ``None`` where
            nothing in the scene disperses light.
        history: What the program of the walk knows of the path so far
            (:class:`.path_program.PathProgram`); ``None`` if it needs nothing.
        events: The state of the automaton that reads the path
            (:class:`.path_events.PathEvents`); ``None`` without light path expressions.
        sums: The light that the path has brought to each cell of the automaton.
    """

    β: mi.Spectrum
    η: mi.Float
    sampling_weight: mi.Float
    depth: mi.UInt32
    arrival: Arrival
    hero_is_alone: mi.Bool | None
    history: Any = None
    events: Any = None
    sums: Any = None


@dataclass
class MediumVertex:
    """The part of a vertex that concerns participating media.

    Attributes:
        scatters: Whether the path scatters in a medium. Elsewhere, its vertex is on a surface.
        mei: The interaction there, without the coefficients of the medium. On a surface, it still
            has the medium through which the path has arrived.
        attenuation: The transmittance of the homogeneous medium on the way from the previous vertex
            or index-matched surface, as the mean over the colours; 1 for other media.
        weight: 1 / density of the number that chose the distance of the flight; ``None`` where all
            numbers are uniform.
    """

    scatters: mi.Bool
    mei: mi.MediumInteraction3f
    attenuation: mi.Float | None = None
    weight: mi.Float | None = None


@dataclass
class FlightEnd:
    """The end of a flight: the vertex, and the throughput up to it.

    Attributes:
        si, β: The interaction at the vertex, and the throughput.
        in_medium: The part of the vertex that concerns media.
    """

    si: mi.SurfaceInteraction3f
    β: mi.Spectrum
    in_medium: MediumVertex | None


@dataclass
class Vertex:
    """A point on a surface or in a medium that a path has reached.

    Attributes:
        si: The interaction there. In a medium, it has neither shape nor normal.
        bsdf: The BSDF there; null in a medium.
        path: The state of the path that has reached the vertex.
        pixel: Index, row by row, of the film pixel in which the path begins; ``None`` if unknown.
        medium: The part that concerns media; ``None`` if the scene has none.
        lobes: The values of the diffuse lobes of the BSDF (:class:`.bsdfs.DiffuseLobes`), for light
            path expressions; ``None`` if they are not wanted.
        sampling_weight: Where directions are not drawn from the BSDF alone: the density of the
            sampled one among BSDF samples / its density (:class:`PathState`).
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    path: PathState
    pixel: mi.UInt32 | None = None
    medium: MediumVertex | None = None
    lobes: Any = None
    sampling_weight: mi.Float | float = 1.0

    @property
    def depth(self) -> mi.UInt32:
        """0 at the first vertex of a path."""
        return self.path.depth

    @property
    def is_smooth(self) -> mi.Bool:
        """Whether the BSDF has a lobe that is not specular; false in media."""
        return mi.has_flag(self.bsdf.flags(), mi.BSDFFlags.Smooth)
