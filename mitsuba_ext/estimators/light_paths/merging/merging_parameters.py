"""The parameters of merging, which ``vcm`` and ``sppm`` share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ....rendering.camera import film_extent
from ....scene.movers import movers
from ..light_walk import LightWalk
from ..photons.medium_photons import suitable_ball, widest_ball
from .merging import median_footprint, scene_diagonal, suitable_radius, widest_radius
from .merging_radius import MergingRadius
from .shared_numbers import TIME_STEP, WAVELENGTH_STEP, SharedNumbers


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
        radius: Radius with one sample per pixel; 0 for one that suits the scene.
        decay: See :class:`MergingRadius`.
    """

    radius: float
    decay: float

    @classmethod
    def read(cls, integrator: Any, props: mi.Properties) -> MergingParameters:
        """Reads ``radius`` and ``radius_decay``."""
        return cls(
            integrator.parameter(props, "radius", 0.0, none="automatic", minimum=0.0),
            integrator.parameter(props, "radius_decay", 0.75, minimum=0.01, maximum=1.0),
        )

    def radius_of(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        light_walk: LightWalk,
        only_caustic: bool,
        before: int,
        alone: bool = False,
    ) -> MergingRadius | None:
        """The radius for a render, before which others have made ``before`` samples per pixel;
        ``None`` if there are no caustics to merge. ``alone`` tells whether merging is the only
        technique. See :func:`suitable_radius` for the other parameters."""
        if only_caustic and not _may_have_caustics(scene):
            return None
        footprint = median_footprint(scene, sensor, light_walk.query)
        if not alone:
            # Samples of a radiance meter share their vertices, and MIS weights do not know it: wide
            # disks would make other techniques noisier
            footprint = footprint or scene_diagonal(scene) / 1000
        width, height = film_extent(sensor.film())
        pixels = width * height
        radius, widest = self.radius, math.inf
        if radius == 0:
            widest = widest_radius(scene, footprint)
            radius = suitable_radius(scene, sensor, light_walk, footprint, pixels, only_caustic)
        if radius is None and only_caustic:
            return None
        return MergingRadius(
            radius or widest, self.decay, pixels, footprint, before, widest
        )

    def ball_of(
        self, scene: mi.Scene, sensor: mi.Sensor, light_walk: LightWalk, before: int, given: float
    ) -> MergingRadius:
        """Like :meth:`radius_of`, for balls in participating media; ``given`` is their radius, 0
        for one that suits the scene."""
        footprint = median_footprint(scene, sensor, light_walk.query)
        width, height = film_extent(sensor.film())
        radius = given or suitable_ball(scene, sensor, light_walk, footprint, width * height)
        radius = radius or widest_ball(scene, footprint)
        return MergingRadius(
            radius, self.decay, width * height, footprint, before, dimensions=3
        )


def _may_have_caustics(scene: mi.Scene) -> bool:
    """Whether a BSDF in ``scene`` may have delta lobes. The BSDFs of instances and moving shapes
    are not known, so they may."""
    bsdfs = [shape.bsdf() for shape in scene.shapes()]
    return any(b is None or int(b.flags()) & int(mi.BSDFFlags.Delta) for b in bsdfs)
