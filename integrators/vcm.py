"""Vertex connection and merging."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bidirectional.merging import MergingRadius, median_footprint
from mitsuba_ext.composition.bidirectional_integrator import BidirectionalIntegrator
from mitsuba_ext.rendering.camera import film_extent
from mitsuba_ext.startup import registry

#: The default radius, in widths of a pixel.
_PIXELS = 2.0


@registry.plugin
class VertexConnectionAndMerging(BidirectionalIntegrator):
    r"""
    .. _integrator-vcm:

    Vertex connection and merging (:monosp:`vcm`)
    ---------------------------------------------
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.merging = self.parameter(props, "merging", True)
        self.radius = self.parameter(props, "radius", 0.0, minimum=0.0)
        self.radius_decay = self.parameter(props, "radius_decay", 0.75, minimum=0.01, maximum=1.0)

    def parameters(self) -> dict[str, Any]:
        return {
            "merging": self.merging,
            "radius": self.radius or "automatic",
            "radius_decay": self.radius_decay,
            **super().parameters(),
        }

    def merging_radius(self, scene: mi.Scene, sensor: mi.Sensor) -> MergingRadius | None:
        radius = self.radius or _PIXELS * median_footprint(scene, sensor)
        if not self.merging or radius == 0:
            return None
        width, height = film_extent(sensor.film())
        return MergingRadius(radius, self.radius_decay, width * height)
