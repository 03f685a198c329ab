"""What a technique that learns is made of."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..transport.observer import Observer


class Learner(Observer):
    """A technique that learns in pilot stages. One object serves one render."""

    #: Does :meth:`start` need to know where paths scatter?
    wants_scout = False

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> dict[str, Any]:
        """The decisions of the first pilot. ``p``, ``n``: vertices and normals of the scout, none
        if no learner wants one."""
        raise NotImplementedError

    def learn(self, scene: mi.Scene, is_last: bool) -> dict[str, Any]:
        """The decisions of the next stage, which is the last one if ``is_last`` says so."""
        raise NotImplementedError

    def __str__(self) -> str:
        """A summary of what was learned."""
        raise NotImplementedError
