"""Path guiding in primary sample space."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.decisions.defaults import EmitterSampling
from mitsuba_ext.decisions.guide_learner import GuideLearner
from mitsuba_ext.decisions.guided_directions import LaterConnections
from mitsuba_ext.integrator import WalkIntegrator
from mitsuba_ext.learning.learner import Learner


@registry.plugin
class PSSGuided(WalkIntegrator):
    r"""
    .. _integrator-pss_guided:

    Path guiding in primary sample space (:monosp:`pss_guided`)
    -----------------------------------------------------------
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        get = self.parameter
        self.regions = get(props, "regions", "surfaces", choices=("surfaces", "tiles"))
        tiles = self.regions == "tiles"
        self.tile = get(props, "tile", 16, minimum=1) if tiles else None
        self.bounces = get(props, "bounces", 2 if tiles else 6, minimum=1, maximum=5 if tiles else 64)
        self.nee_first_bounce = get(props, "nee_first_bounce", True)
        self.pilot_spp = get(props, "pilot_spp", 16, minimum=0)
        self.max_memory = get(props, "max_memory", 512.0, minimum=1e-3)

    def decisions(self, scene: mi.Scene) -> dict[str, Any]:
        return {} if self.nee_first_bounce else {"next_event": LaterConnections(EmitterSampling())}

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        samples = min(self.pilot_spp, spp // 4)
        if samples < 2 or self.max_depth < 2:
            return []
        return [max(1, samples // 4), samples - max(1, samples // 4)]

    def learners(self, scene: mi.Scene, samples: int) -> list[Learner]:
        if samples == 0:
            return []
        return [GuideLearner(self.tile, self._extent, min(self.bounces, self.max_depth-1), int(self.max_memory*2**20), samples)]

    def stages(self, scene, sensor, samples):
        from mitsuba_ext import camera
        self._extent = camera.film_extent(sensor.film())
        yield from super().stages(scene, sensor, samples)

    def parameters(self) -> dict[str, Any]:
        return {}
