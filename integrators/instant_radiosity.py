"""Instant radiosity: virtual point lights, with bounded connections and exact compensation."""

from __future__ import annotations

import functools
import math
from typing import Any

import mitsuba as mi

from mitsuba_ext.bidirectional.instant_radiosity import InstantRadiosity, Tally
from mitsuba_ext.bidirectional.light_walk import LightWalk
from mitsuba_ext.bidirectional.merging import scene_diagonal
from mitsuba_ext.bidirectional.virtual_light_bound import Bound
from mitsuba_ext.bidirectional.virtual_light_choice import PowerChoice, UniformChoice
from mitsuba_ext.bidirectional.virtual_light_tree import ClusteredChoice
from mitsuba_ext.bidirectional.virtual_lights import MOST_PATHS, Sets
from mitsuba_ext.composition.light_side import LightSide
from mitsuba_ext.composition.slots import read_slot
from mitsuba_ext.composition.subpath_selection import LearnedSubpaths
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.rendering.camera import film_extent
from mitsuba_ext.scene.movers import movers
from mitsuba_ext.startup import registry
from mitsuba_ext.transport.estimator import Estimator

#: How virtual lights are chosen; "learned" is a slot of the walk.
_CHOICES = {
    "uniform": UniformChoice, "power": PowerChoice, "clustered": ClusteredChoice, "learned": None,
}  # fmt: skip


@registry.plugin
class InstantRadiosityIntegrator(WalkIntegrator):
    r"""
    """

    has_light_paths = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.light_paths = self.parameter(
            props, "light_paths", 1000, minimum=1, maximum=MOST_PATHS
        )
        self.interleaving = self.parameter(props, "interleaving", 1, minimum=1, maximum=64)
        self.connections = self.parameter(props, "connections", 1, minimum=1, maximum=65536)
        self.choice = self.parameter(props, "choice", "uniform", choices=tuple(_CHOICES))
        self.bound = self.parameter(props, "bound", 10.0, minimum=0.0)
        self.compensation = self.parameter(props, "compensation", True)
        slots = {key: read_slot(self.name, props, key) for key in ("next_event", "shadow_test")}
        if self.choice == "learned":
            slots["subpath_selection"] = LearnedSubpaths()
        self.fill(props, **slots)
        self._tally, self._largest = Tally(), math.inf

    def parameters(self) -> dict[str, Any]:
        return {
            "light_paths": self.light_paths,
            "interleaving": self.interleaving,
            "connections": self.connections,
            "choice": self.choice,
            "bound": self.bound,
            "compensation": self.compensation,
            **super().parameters(),
        }

    @property
    def sample_cost(self) -> int:
        return max(2, super().sample_cost)

    def estimators(self, scene, sensor):
        self._check(scene)
        if not scene.emitters() or self.max_depth < 3:
            return self.walk
        side = LightSide.of(self.name, scene, sensor, has_image=False)
        self._largest = self.bound / scene_diagonal(scene) ** 2
        width, height = film_extent(sensor.film())
        sets = Sets(width * height, width, self.light_paths, self.interleaving)
        return functools.partial(self._estimator, side, sets)

    def _check(self, scene: mi.Scene) -> None:
        """
        Raises:
            NotImplementedError: Virtual lights cannot be shared by all camera paths in this scene.
        """
        reason = "the variant is spectral" if mi.is_spectral else "shapes or lights move"
        if mi.is_spectral or movers(scene):
            raise NotImplementedError(
                f'"{self.name}": {reason}: camera paths of other wavelengths and times cannot '
                f'share virtual lights; use "bdpt" or "path"'
            )

    def _estimator(self, side: LightSide, sets: Sets, **decisions: Any) -> Estimator:
        selection = decisions.pop("subpath_selection", None)
        next_event = side.next_event(decisions.pop("next_event", None))
        if next_event is not None:
            decisions["next_event"] = next_event
        walk = self.walk(**decisions)
        light_walk = LightWalk(side.emission, self.max_depth, self.rr_depth, query=walk.query)
        chosen = {} if selection is None else {"selection": selection}
        return InstantRadiosity(
            walk, light_walk, sets, Bound(self._largest, self.compensation), self.connections,
            _CHOICES[self.choice] or UniformChoice, tally=self._tally, **chosen,
        )  # fmt: skip

    def render_once(self, scene, sensor, seed, spp, develop, evaluate):
        self._tally, self._largest = Tally(), math.inf
        image = super().render_once(scene, sensor, seed, spp, develop, evaluate)
        if self._tally.sets:
            lights = self._tally.lights / self._tally.sets
            what = f"{lights:.0f} virtual lights in a set, {self._tally.sets} sets, connections "
            what += f"bounded by {self._largest:.3g} / length²"
            self.statistics.learned = "; ".join(filter(None, (self.statistics.learned, what)))
        return image
