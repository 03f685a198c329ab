"""A small scene, and renders of it whose samples are constants: what the film holds is known."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.rendering import render as rendering
from mitsuba_ext.rendering.device import SampleBytes
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import Learning, Schedule, Stage
from mitsuba_ext.transport.estimator import Sample

#: The size of the film.
WIDTH, HEIGHT = 12, 8


def small_scene() -> mi.Scene:
    """A sphere under a point light."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT,
                         "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 5},
            },
            "sphere": {"type": "sphere"},
            "lamp": {"type": "point", "position": [2, 3, 4]},
        }
    )


class Constant:
    """An estimator whose every sample is worth the same."""

    def __init__(self, value: float, can_be_frozen: bool = False) -> None:
        self.value, self.can_be_frozen = value, can_be_frozen

    def __call__(self, scene, sampler, rays, active):
        zero = dr.zeros(mi.UInt32, dr.width(rays.ray))
        return Sample(mi.Color3f(self.value), mi.Bool(True), zero, zero, zero)


class FixedSchedule(Schedule):
    """Stages that are there beforehand."""

    def __init__(self, *stages: Stage) -> None:
        self._stages = iter(stages)

    def next_stage(self) -> Stage:
        return next(self._stages)

    def divide_first_stage(self, pixel_count: int) -> int:
        return 1

    def end_learning(self) -> None:
        pass

    def finish(self, statistics) -> None:
        pass


class TwoStages:
    """Two stages of constants: a pilot worth 1 and a rest worth 3."""

    has_ray_aovs = False

    def __init__(self, pilot_spp: int, timeout: float = -1) -> None:
        self.pilot_spp, self.timeout, self.samples_per_pass = pilot_spp, timeout, 2**32 - 1
        self.is_cancelled, self.masks = False, ()
        self.name, self.sample_cost, self.sample_bytes = "two_stages", 1, SampleBytes()
        self.channel_bytes = 0

    def plan_learning(self, request, spp):
        return Learning((self.pilot_spp,))

    def samples_per_set(self, spp):
        return 1

    def pace_stage(self, request, spp):
        return None

    def schedule(self, request, samples, learning):
        return FixedSchedule(Stage(Constant(1.0)), Stage(Constant(3.0), "something"))

    def aov_names(self):
        return []

    def sample_aovs(self, scene, sampler, ray):
        return []

    def render(self, scene: mi.Scene, spp: int, **rest) -> np.ndarray:
        request = Request(scene, scene.sensors()[0], 0, spp, timeout=self.timeout)
        return rendering.render(self, request).numpy()
