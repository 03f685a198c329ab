"""The estimator of a light tracer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.estimator import CameraRays, Sample, Splats
from ..transport.numbers import Numbers
from ..transport.walk import Walk
from .light_image import light_image
from .light_walk import LightWalk
from .sensor import ConnectableSensor

#: Vertices of a path that are stored at a time. Most paths have fewer.
STRIDE = 4

#: Rounds of a path, at most: it has been stuck where nothing absorbs light.
_MOST_ROUNDS = 1 << 12


@dataclass
class LightTracer:
    """Traces a light path for each camera ray; it is an :class:`Estimator`. The camera rays see
    emitters; light paths find everything else.

    Parameters:
        directly: The walk of the camera rays, which ends where they meet something.
        light_walk: The walk of the light paths; ``None`` where there is no light.
        sensor: What the paths are connected to.
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
        seed = None
        if self.sensor.needs_aperture_sample:
            seed = mi.UInt32(sampler.next_1d() * 4294967040.0)
        paths = self.light_walk.begin(
            scene, sampler, rays.ray.time, rays.ray.wavelengths, active
        )
        # What the rest of the pass reads again
        dr.eval(paths, sample, seed, rays.ray.wavelengths, rays.importance)
        splats: list[Splats] = []
        shadow_count = mi.UInt32(0)
        for _ in range(_MOST_ROUNDS):
            vertices, paths = self.light_walk.advance(scene, sampler, paths, STRIDE)
            if vertices.count > 0:
                found, tested = light_image(
                    scene, self.sensor, vertices, seed, rays.importance,
                    query=self.light_walk.query, hides_emitters=self.directly.hide_emitters,
                )  # fmt: skip
                # Now, so that the memory of the vertices is free again
                dr.eval(found, tested)
                splats.append(found)
                shadow_count += dr.sum(tested)
            if not dr.any(paths.active)[0]:
                break
        scatter_count = sample.scatter_count + paths.scatter_count
        return replace(
            sample, splats=_joined(splats), scatter_count=scatter_count, shadow_count=shadow_count
        )


def _joined(splats: list[Splats]) -> list[Splats]:
    """The splats of all rounds as one: however many rounds there were, the film adds them by the
    same kernel."""
    if len(splats) < 2:
        return splats
    first = splats[0]
    wavelengths = None
    if first.wavelengths is not None:
        wavelengths = _one_after_the_other([s.wavelengths for s in splats])
    return [
        Splats(
            _one_after_the_other([s.value for s in splats]),
            _one_after_the_other([s.position for s in splats]),
            wavelengths,
            dr.concat([s.active for s in splats]),
        )
    ]


def _one_after_the_other(vectors: list[Any]) -> Any:
    components = zip(*vectors)
    return type(vectors[0])(*(dr.concat(list(component)) for component in components))
