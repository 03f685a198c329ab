"""Photons in participating media: vertices at which light paths scatter there, merged with those of
camera paths that lie in a ball around them.

The light that arrives at x and is scattered towards the camera, Σ f_p β / (N · 4/3 π r³), is summed
over the vertices in a ball of radius r, of N light paths: their density is proportional to the
radiance times the coefficient of scattering, which the light walk divides out of β.

Source: H. W. Jensen, P. H. Christensen, *Efficient Simulation of Light Transport in Scenes with
Participating Media Using Photon Maps*, SIGGRAPH 1998; C. Knaus, M. Zwicker, *Progressive Photon
Mapping: A Probabilistic Approach*, ACM Transactions on Graphics 30(3), 2011, section 6.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from ..transport.media import eval_phase
from ..transport.vertex import Vertex
from .light_vertices import LightVertex
from .light_walk import LightWalk
from .merging import (
    DOUBLINGS,
    FEW,
    HANDFUL,
    LARGEST,
    PILOT_PATHS,
    WIDEST,
    MergedSubpaths,
    pilot_vertices,
    scene_diagonal,
)
from .vertex_grid import VertexGrid


class MergedInMedia(MergedSubpaths):
    """Adds to each vertex of a camera path in a medium what light paths bring to vertices around
    it."""

    def _measure(self, radius):
        return 4 / 3 * dr.pi * radius * radius * radius

    def _is_merged(self, vertex):
        return vertex.medium.scatters

    def _merged(self, vertex: Vertex, other: LightVertex, active: mi.Bool) -> mi.Spectrum:
        """Phase function · flux of one light path."""
        si, far, mei = vertex.si, other.si, vertex.medium.mei
        active = active & (vertex.depth + other.depth + 1 <= self._max_depth)
        if self._shares_rays:
            active &= (far.time == si.time) & dr.all(far.wavelengths == si.wavelengths)
        wo = far.to_world(far.wi)
        value = mi.Spectrum(eval_phase(mei, wo, active)[0])
        value = self._heroes.merge(
            vertex.path.hero_is_alone, other.hero_is_alone, value, vertex.bsdf, si,
            si.to_local(wo),
        )  # fmt: skip
        value *= other.β
        active &= dr.all(dr.isfinite(value))
        return dr.select(active, value, 0)


def suitable_ball(
    scene: mi.Scene, sensor: mi.Sensor, light_walk: LightWalk, footprint: float, pixels: int
) -> float | None:
    """The radius in which a ball holds a handful of the vertices of one light path per pixel: the
    median over the vertices in media, since they are dense without bounds near small lamps.
    Measured by a few light paths; ``None`` if these leave too few vertices in media.

    Parameters:
        light_walk: Traces the light paths.
        footprint: The width of a pixel where the camera sees the scene.
    """
    vertices = pilot_vertices(scene, sensor, light_walk)
    if vertices is None:
        return None
    for doublings in range(DOUBLINGS):
        radius = 2 * footprint * 2**doublings
        grid = VertexGrid(vertices, dr.opaque(mi.Float, radius), vertices.is_in_medium)
        if grid.count < FEW:
            return None
        others = grid.median_occupancy
        if others > 4:
            break
    per_volume = max(others, 1e-6) / (2 * radius) ** 3
    count = HANDFUL * PILOT_PATHS / pixels
    found = (count / (4 / 3 * math.pi * per_volume)) ** (1 / 3)
    return min(found, WIDEST * footprint, LARGEST * scene_diagonal(scene))
