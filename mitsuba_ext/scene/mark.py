"""Recognizes a scene later without keeping it alive."""

from __future__ import annotations

import mitsuba as mi


class SceneMark:
    """Holds an array of a scene. While it is held, no other array can get its index.

    Scenes cannot be referenced weakly. An integrator must not hold a scene: if it is the scene's
    own integrator, the two would keep each other alive, and Dr.Jit, which searches the attributes
    of both for arrays, would never finish. (It does not look into objects such as this one.)

    Attributes:
        index: Identifies the scene; 0 if it has neither shapes nor lights.
    """

    def __init__(self, scene: mi.Scene) -> None:
        arrays = scene.shapes_dr(), scene.emitters_dr()
        self.array = next((array for array in arrays if len(array) > 0), None)
        self.index = 0 if self.array is None else self.array.index

    def is_of(self, scene: mi.Scene) -> bool:
        """Whether this is the mark of ``scene``."""
        return self.index > 0 and self.index == SceneMark(scene).index
