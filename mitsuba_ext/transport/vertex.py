"""What a random walk knows of the vertex that it has reached."""

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
            it met: 1 / density of guided numbers, and 4 where one of four wavelengths is left.
            Russian roulette divides it out.
        depth: Number of vertices before this one, without the sensor's.
        arrival: How the path came to the vertex.
        hero_is_alone: Is only the first of the four wavelengths left? ``()`` where nothing in the
            scene disperses light.
        sums: What the path knows of other ways to make it, for MIS weights; ``()`` where the
            densities at the last vertex suffice.
    """

    β: mi.Spectrum
    η: mi.Float
    sampling_weight: mi.Float
    depth: mi.UInt32
    arrival: Arrival
    hero_is_alone: Any
    sums: Any = ()


@dataclass
class MediumVertex:
    """What is known of a vertex in a medium.

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
        path: What the path brings along.
        pixel: Where on the film the path begins, row by row; ``None`` where nobody has said.
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
