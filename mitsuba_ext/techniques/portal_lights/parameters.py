"""The parameters of portal sampling."""

from __future__ import annotations

from typing import Any

from ...planning.technique import ParameterReader, Setting, Technique
from ...scene.portals import portals
from .portal_sampling import PortalSampling


class PortalLights(Technique):
    """Samples directions of the environment through portals. The attributes are the parameters of
    the plugin ``portal_lights``; see there."""

    name, is_plugin = "portal_lights", True
    slots, words = ("next_event",), {"portals": {}}
    camera_paths_only = True

    def __init__(self, read: ParameterReader) -> None:
        self.share = read("share", 0.9, minimum=0.0, maximum=0.99)

    def decision(self, setting: Setting) -> Any | None:
        scene = setting.scene
        if scene.environment() is None or not portals(scene) or self.share == 0:
            return None
        return PortalSampling(scene, self.share)


TECHNIQUES = (PortalLights,)
