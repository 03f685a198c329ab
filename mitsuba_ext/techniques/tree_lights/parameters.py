"""The parameters of light selection by a light tree: it has none."""

from __future__ import annotations

from typing import Any

from ...planning.technique import Setting, Technique
from ...transport.tree_choice import tree_choice


class TreeLights(Technique):
    """Chooses lights by a light tree."""

    name = "tree"
    slots, words = ("next_event",), {"tree": {}}

    def decision(self, setting: Setting) -> Any | None:
        return tree_choice(setting.scene)


TECHNIQUES = (TreeLights,)
