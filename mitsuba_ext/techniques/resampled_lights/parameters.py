"""The parameters of resampled lights."""

from __future__ import annotations

from typing import Any

from ...planning.costs import CANDIDATES_PER_PATH
from ...planning.technique import ParameterReader, Setting, Technique
from .resampled_lights import ResampledLights


class ResampledLightsChoice(Technique):
    """Chooses one of several candidate lights by what each would contribute. The attributes are the
    parameters of the plugin ``resampled_lights``; see there."""

    name, is_plugin = "resampled_lights", True
    slots, words = ("next_event",), {"resampled": {}}
    camera_paths_only = True
    sees_media = False

    def __init__(self, read: ParameterReader) -> None:
        self.candidates = read("candidates", 8, minimum=1, maximum=1024)

    @property
    def sample_cost(self) -> int:
        return 1 + self.candidates // CANDIDATES_PER_PATH

    def decision(self, setting: Setting) -> Any | None:
        if not setting.scene.emitters():
            return None
        return ResampledLights(setting.scene, self.candidates)


TECHNIQUES = (ResampledLightsChoice,)
