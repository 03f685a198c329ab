"""The estimator of a light tracer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...scene.media import may_have_grids
from ...transport.estimator import CameraRays, Sample, Splats
from ...transport.numbers import Numbers
from ...transport.walk import Walk
from ...util.arrays import joined
from .light_image import LightImage
from .light_numbers import LightPathRays
from .light_walk import LightWalk
from .medium_scattering import MediumTerms
from .scattering import SurfaceTerms
from .sensor import ConnectableSensor


@dataclass
class LightTracer:
    """Traces a light path for each camera ray; it is an :class:`Estimator`. Camera rays only add
    the emitters that they hit directly; light paths add everything else.

    Parameters:
        directly: The walk of the camera rays, which ends at the first intersection.
        light_walk: The walk of the light paths; ``None`` if the scene has no light.
        sensor: The sensor to which the light paths are connected.
    """

    directly: Walk
    light_walk: LightWalk | None
    sensor: ConnectableSensor

    def __call__(
        self, scene: mi.Scene, sampler: Numbers, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        sample = self.directly(scene, sampler, rays, active)
        if self.light_walk is None:
            return sample
        walk = self.light_walk
        terms = SurfaceTerms()
        if walk.outside is not None:
            terms = MediumTerms(may_have_grids(scene))
        image = LightImage(
            scene, self.sensor, sampler, rays, query=walk.query,
            hides_emitters=self.directly.hide_emitters, channels=walk.channels,
            terms=terms,
        )  # fmt: skip
        # Evaluated now, since later kernels of the pass read them again
        dr.schedule(sample, rays.ray.wavelengths)
        light = LightPathRays.of(sampler, rays)
        splats: list[Splats] = []
        scatter_count = walk.run_in_rounds(
            scene, light.numbers, light.time, light.wavelengths, light.emits(active),
            lambda vertices: splats.append(image.splats(vertices)),
        )  # fmt: skip
        return replace(
            sample,
            splats=[joined(splats)] if len(splats) > 1 else splats,
            scatter_count=sample.scatter_count + scatter_count,
            shadow_count=image.shadow_count,
        )
