"""The parameters of learned lights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import ParameterReader, Setting, Slots, Technique
from ...rendering.camera import film_extent
from ...util import archives
from ...util.errors import InputError
from . import light_map_file
from .learner import LightMapLearner

#: What the map of :class:`LearnedLights` can learn of each light, the default first.
TARGETS = ("contribution", "visibility")


class LearnedLights(Technique):
    """Chooses lights by what the pilots' samples found. The attributes are the parameters of the
    plugin ``learned_lights``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "learned_lights", True
    slots = ("next_event",)
    words = {target: {"target": target} for target in reversed(TARGETS)}
    pilot_spp, tries, tells_visibility = 16, True, True

    def __init__(self, read: ParameterReader, target: str = "") -> None:
        self.target = target or read("target", TARGETS[0], choices=TARGETS)
        self.grid = read.optional_count("grid", 1024)
        self.max_memory = read("max_memory", 512.0, minimum=1e-3)
        self.load_map = read("load_map", "")
        self.save_map = read("save_map", "")
        self._plugin = read.plugin

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        learns = spp > 0 and bool(scene.emitters()) and bool(scene.shapes())
        if self.save_map and not self.load_map and not learns:
            mi.Log(mi.LogLevel.Warn, f'Nothing is learned: "{self.save_map}" is not written.')
        return learns

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        """
        Raises:
            ValueError: The file ``save_map`` cannot be written.
        """
        if self.save_map:
            try:
                archives.check_target(Path(self.save_map), light_map_file.FORM)
            except InputError as error:
                raise ValueError(f'"{self._plugin}": "save_map": {error}') from None
        scene = setting.scene
        if not scene.emitters() or not scene.shapes():
            return None
        if setting.pilot_spp == 0 and not self.load_map:
            return None
        return LightMapLearner(
            self.target,
            self.grid,
            int(self.max_memory * 2**20),
            setting.pilot_samples,
            film_extent(setting.sensor.film())[0],
            setting.pixel_count * setting.spp,
            Path(self.load_map) if self.load_map else None,
            Path(self.save_map) if self.save_map else None,
            self._plugin,
        )

    def parameters(self, *slots: Slots) -> dict[str, Any]:
        return {**super().parameters(*slots), "grid": self.grid or "automatic"}


TECHNIQUES = (LearnedLights,)
