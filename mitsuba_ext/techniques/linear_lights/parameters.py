"""The parameters of linear light selection: it has none."""

from __future__ import annotations

from typing import Any

from ...planning.technique import Setting, Technique
from .linear_lights import LinearChoice


class LinearLights(Technique):
    """Chooses lights by an estimate of what each contributes to the vertex."""

    name = "linear"
    slots, words = ("next_event",), {"linear": {}}
    sees_media = False

    def decision(self, setting: Setting) -> Any | None:
        return LinearChoice(setting.scene) if len(setting.scene.emitters()) > 1 else None


TECHNIQUES = (LinearLights,)
