"""The slot ``shadow_test``: whether the shadow ray of a connection is traced."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Slots, Technique
from ...transport.rejection_law import RejectionLaw
from .visibility_roulette import has_lights_at_points
from .visibility_roulette_learner import VisibilityRouletteLearner

#: Voxels along each axis where the scene's author does not say.
_GRID = 16

#: Parameters of the roulette's own visibility map.
_OF_OWN_MAP = ("grid", "max_memory", "refine")


class RejectedShadowRays(Technique):
    """Russian roulette of shadow rays by learned visibility. The attributes are the parameters of
    the plugin ``visibility_roulette``; see there.

    Where the choice of lights is learned too, the roulette uses the visibility of the light map.

    Parameters:
        read: Reads the parameters.
        has_own_map: False if the choice of lights is always learned: the roulette then has no
            parameters of its own map.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "visibility_roulette", True
    slots, words = ("shadow_test",), {"visibility_roulette": {}}
    pilot_spp = 16

    def __init__(self, read: ParameterReader, has_own_map: bool = True) -> None:
        self.law = read("law", "affine", choices=("affine", "paper"))
        if self.law == "affine":
            self.slope = read("slope", 10.0, minimum=0.0)
            self.floor = read("floor", 0.1, minimum=1e-6, maximum=1.0)
        self._has_own_map = has_own_map
        self._given: list[str] = []
        if has_own_map:
            self.grid = read("grid", _GRID, minimum=1, maximum=1024)
            self.max_memory = read("max_memory", 512.0, minimum=1e-3)
            self.refine = read("refine", 16, minimum=0, maximum=1024)
            self._given = [key for key in _OF_OWN_MAP if read.is_given(key)]

    def check_together(self, plugin: str, slots: Slots) -> None:
        if self._given and not self._uses_own_map(slots):
            raise ValueError(
                f'"{plugin}": the parameter "{self._given[0]}" of "shadow_test" has no effect '
                f'where "next_event" learns lights, whose map the shadow test uses: leave it out'
            )

    def parameters(self, slots: Slots = MappingProxyType({})) -> dict[str, Any]:
        of_own_map = () if self._uses_own_map(slots) else _OF_OWN_MAP
        own = super().parameters(slots)
        return {key: value for key, value in own.items() if key not in of_own_map}

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and (not self._has_own_map or has_lights_at_points(scene))

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        law = RejectionLaw(self.law, getattr(self, "slope", 0.0), getattr(self, "floor", 1.0))
        if "next_event" in others and others["next_event"].tells_visibility:
            return others["next_event"].shadow_test(law)
        if not self._has_own_map or not self.can_learn(setting.scene, setting.pilot_spp):
            return None
        return VisibilityRouletteLearner(self.grid, self.max_memory, self.refine, law)

    def _uses_own_map(self, slots: Slots) -> bool:
        return not getattr(slots.get("next_event"), "tells_visibility", False)


TECHNIQUES = (RejectedShadowRays,)
