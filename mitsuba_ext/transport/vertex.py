"""The state of a random walk at the vertex that it has reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi


@dataclass
class Arrival:
    """How a path came to its vertex.

    Attributes:
        ref: The vertex before; meaningless at the first one.
        pdf: Solid angle density, at ``ref``, of the direction that led here.
        is_delta: Did a discrete distribution choose that direction (a mirror, or the sensor)? Then
            no connection could have found this vertex.
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
            is left. Russian roulette divides it out.
        depth: Number of vertices before this one, without the sensor's.
        arrival: How the path came to the vertex.
        hero_is_alone: Whether only the first of the four wavelengths is left; ``None`` where
            nothing in the scene disperses light.
        history: What the program of the walk knows of the path so far
            (:class:`.path_program.PathProgram`); ``None`` if it needs nothing.
    """

    β: mi.Spectrum
    η: mi.Float
    sampling_weight: mi.Float
    depth: mi.UInt32
    arrival: Arrival
    hero_is_alone: mi.Bool | None
    history: Any = None


@dataclass
class MediumVertex:
    """The part of a vertex that concerns participating media.

    Attributes:
        scatters: Does the path scatter in a medium? Elsewhere, its vertex is on a surface.
        mei: The interaction there, without coefficients of the medium.
    """

    scatters: mi.Bool
    mei: mi.MediumInteraction3f


@dataclass
class Vertex:
    """A point of a surface or of a medium that a path has reached.

    Attributes:
        si: The interaction there. In a medium, it has neither shape nor normal.
        bsdf: Its BSDF; null in a medium.
        path: The state of the path that has reached the vertex.
        pixel: Index of the film pixel in which the path begins, row by row; ``None`` if unknown.
        medium: ``None`` where the scene has no media.
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    path: PathState
    pixel: mi.UInt32 | None = None
    medium: MediumVertex | None = None

    @property
    def depth(self) -> mi.UInt32:
        """0 at the first vertex of a path."""
        return self.path.depth
