"""The parameters of merging, which ``vcm`` and ``sppm`` share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi

from ....rendering.camera import film_extent
from ....scene.movers import movers
from ..light_walk import LightWalk
from .merging import (
    median_footprint,
    pilot_vertices,
    scene_diagonal,
    suitable_radius,
    widest_radius,
)
from .merging_in_media import median_free_path, suitable_ball, widest_ball
from .merging_radius import MergingRadii, MergingRadius
from .shared_numbers import TIME_STEP, WAVELENGTH_STEP, SharedNumbers
from .vertex_grid import all_of


def shared_numbers(scene: mi.Scene, seed: int) -> dict[str, SharedNumbers]:
    """Numbers, by slot, with which sample k of each pixel has the same time where things move, and
    the same wavelengths: only paths that have these in common can be merged."""
    shared = {}
    if movers(scene):
        shared["time"] = SharedNumbers(TIME_STEP, seed, 1)
    if mi.is_spectral:
        shared["wavelength"] = SharedNumbers(WAVELENGTH_STEP, seed, 2)
    return shared


@dataclass
class MergingParameters:
    """
    Attributes:
        radius: Radius of disks with one sample per pixel; 0 for one that suits the scene.
        decay: See :class:`MergingRadius`.
        radius_in_media: The same for balls in participating media.
    """

    radius: float
    decay: float
    radius_in_media: float = 0.0

    @classmethod
    def read(cls, integrator: Any, props: mi.Properties) -> MergingParameters:
        """Reads ``radius``, ``radius_decay`` and ``radius_in_media``."""
        return cls(
            integrator.parameter(props, "radius", 0.0, none="automatic", minimum=0.0),
            integrator.parameter(props, "radius_decay", 0.75, minimum=0.01, maximum=1.0),
            integrator.parameter(props, "radius_in_media", 0.0, none="automatic", minimum=0.0),
        )

    def radii_of(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        light_walk: LightWalk,
        only_caustic: bool,
        before: int,
        alone: bool = False,
    ) -> MergingRadii | None:
        """The radii for a render, before which others have made ``before`` samples per pixel;
        ``None`` if there are no caustics to merge.

        Parameters:
            light_walk: Traces a few light paths, which measure the radii that are 0.
            only_caustic: Whether vertices are merged only where light arrives from a delta lobe.
            alone: Whether merging is the only technique.
        """
        if only_caustic and not _may_have_caustics(scene):
            return None
        in_media = light_walk.outside is not None
        width, height = film_extent(sensor.film())
        pixels = width * height
        footprint = median_footprint(scene, sensor, light_walk.query)
        # Samples of a radiance meter share their vertices, and MIS weights do not know it: wide
        # disks would make other techniques noisier
        seen = footprint if alone else footprint or scene_diagonal(scene) / 1000
        vertices = None
        if self.radius == 0 or (in_media and self.radius_in_media == 0):
            # With their media, whose mean free paths limit the radius
            vertices = pilot_vertices(scene, sensor, replace(light_walk, connects=True))
        caustic = vertices.is_caustic if only_caustic and vertices is not None else None
        disk, ball = None, None
        radius, widest = self.radius, math.inf
        if radius == 0:
            widest = widest_radius(scene, seen)
            if vertices is not None:
                kept = all_of(vertices.is_on_surface if in_media else None, caustic)
                radius = suitable_radius(scene, vertices, kept, seen, pixels) or 0
            if not only_caustic:
                radius = radius or widest
        if radius > 0:
            disk = MergingRadius(radius, self.decay, pixels, seen, before, widest)
        if in_media:
            radius, free_path = self.radius_in_media, 0.0
            if radius == 0 and vertices is not None:
                kept = all_of(vertices.is_in_medium, caustic)
                free_path = median_free_path(vertices, kept)
                radius = suitable_ball(scene, vertices, kept, seen, pixels, free_path) or 0
            if not only_caustic:
                radius = radius or widest_ball(scene, seen)
            if radius > 0:
                ball = MergingRadius(
                    radius, self.decay, pixels, seen, before, dimensions=3, free_path=free_path
                )
        return MergingRadii(disk, ball) if disk or ball else None


def _may_have_caustics(scene: mi.Scene) -> bool:
    """Whether a BSDF in ``scene`` may have delta lobes. The BSDFs of instances and moving shapes
    are not known, so they may."""
    bsdfs = [shape.bsdf() for shape in scene.shapes()]
    return any(b is None or int(b.flags()) & int(mi.BSDFFlags.Delta) for b in bsdfs)
