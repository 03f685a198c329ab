"""What a technique that learns is made of."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..transport.observer import Observer


class Learner(Observer):
    """Learns one decision of the walk in pilot stages. One object serves one render."""

    #: Does :meth:`start` need to know where paths scatter?
    wants_scout = False

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any | None:
        """The decision of the first pilot; ``None`` for the one that is there. ``p``, ``n``:
        vertices and normals of the scout, none if no learner wants one."""
        raise NotImplementedError

    def learn(self, scene: mi.Scene, is_last: bool) -> Any | None:
        """The decision of the next stage, which is the last one if ``is_last`` says so; ``None``
        for the same as before."""
        raise NotImplementedError

    def state(self) -> dict[str, np.ndarray]:
        """What the decision of the last stage is made of, once that has been learned; empty where
        it is that of Mitsuba's ``path``."""
        return {}

    def restore(self, scene: mi.Scene, state: dict[str, np.ndarray]) -> Any | None:
        """The decision of the last stage, from a :meth:`state` that is not empty, for the same
        scene. Nothing else is asked of a learner that is restored."""
        raise NotImplementedError

    def finish(self) -> None:
        """All have learned: lets go of what the last stage does not need."""

    def __str__(self) -> str:
        """A summary of what was learned; empty if another learner's says it."""
        raise NotImplementedError
