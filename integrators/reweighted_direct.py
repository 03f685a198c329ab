"""Direct light from weighted sets of light samples."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.decisions.many_connections import ManyConnections
from mitsuba_ext.decisions.weighted_sets import SetKind
from mitsuba_ext.integrator import WalkIntegrator


@registry.plugin
class ReweightedDirect(WalkIntegrator):
    r"""
    .. _integrator-reweighted_direct:

    Reweighted light samples (:monosp:`reweighted_direct`)
    ------------------------------------------------------
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.set_kind = SetKind(self.name, props, pattern="lattice", weights="none")
        self.camera_samples = self.parameter(props, "camera_samples", 0, minimum=0)
        self.light_samples = self.parameter(props, "light_samples", 256, minimum=1)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        spp = spp or self.camera_samples
        return super().render(scene, sensor, seed, spp, develop, evaluate)

    def decisions(self, scene: mi.Scene, seed: int) -> dict[str, Any]:
        if not scene.emitters() or self.max_depth < 2:
            return {}
        return {"next_event": ManyConnections(self.set_kind.sets(self.light_samples, 2, seed))}

    def parameters(self) -> dict[str, Any]:
        return {
            **vars(self.set_kind),
            "camera_samples": self.camera_samples,
            "light_samples": self.light_samples,
        }
