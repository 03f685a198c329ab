"""The base class of learners."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..transport.observer import Observer
from ..util.stored_arrays import StoredArrays
from .effect import Effect


class Learner(Observer):
    """Learns one decision of the walk in pilot stages. One object serves one render."""

    #: Does :meth:`start` need to know where paths scatter?
    wants_scout = False

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any | None:
        """The decision of the first pilot; ``None`` keeps the current one. ``p``, ``n``: vertices
        and normals that the scout has found, empty if no learner wants one."""
        raise NotImplementedError

    def learn(self, scene: mi.Scene, is_last: bool) -> Any | None:
        """The decision of the next stage, which is the last one if ``is_last``; ``None`` keeps the
        current one."""
        raise NotImplementedError

    def state(self) -> dict[str, np.ndarray]:
        """The arrays that determine the decision of the last stage, once it has been learned; empty
        where it is that of Mitsuba's ``path``."""
        return {}

    def restore(self, scene: mi.Scene, state: StoredArrays) -> Any | None:
        """The decision of the last stage, from a :meth:`state` that is not empty, for the same
        scene. A restored learner does not learn: only :meth:`finish` and its summary are used."""
        raise NotImplementedError

    def finish(self) -> None:
        """Called after all learners have learned: frees what the last stage does not need."""

    @property
    def effect(self) -> Effect | None:
        """What is known about the decision of the last stage; ``None`` if nothing was tried, or if
        the effect is part of that of another learner."""
        return None

    def __str__(self) -> str:
        """A summary of what was learned; empty if the summary of another learner covers it."""
        raise NotImplementedError
