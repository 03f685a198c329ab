"""The base class of learners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from ..transport.observer import Observer
from ..util.stored_arrays import StoredArrays
from . import verdicts
from .prediction import Effect, Prediction


@dataclass(frozen=True)
class Pilot:
    """A pilot whose samples a learner has observed.

    Attributes:
        scene: The scene.
        is_last: Whether the next stage is the last one.
    """

    scene: mi.Scene
    is_last: bool

    def pays(self, prediction: Prediction) -> bool:
        """Whether a decision is worth its time; in a trial, whether it may be with more samples."""
        return verdicts.pays(prediction, self.is_last)


class Learner(Observer):
    """Learns one decision in pilot stages. One object serves one render. It measures and predicts;
    whether a decision pays is for the planner to say (:meth:`Pilot.pays`).

    In what follows, ``None`` stands for the decision of Mitsuba's ``path``.
    """

    #: Whether :meth:`start` needs to know where paths scatter.
    wants_scout = False

    #: Whether it learns which lights a vertex sees (:meth:`shadow_test`).
    tells_visibility = False

    #: Whether another learner may take the place of this one, where it is more efficient.
    can_be_replaced = False

    #: The slots whose learners this one replaces from now on: they decide as ``path``.
    replaces: tuple[str, ...] = ()

    @property
    def observer(self) -> Observer:
        """What observes the samples of the next pilot."""
        return self

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any | None:
        """The decision of the first pilot. ``p``, ``n``: vertices and normals that the scout has
        found, empty if no learner wants one."""
        raise NotImplementedError

    def learn(self, pilot: Pilot) -> Any | None:
        """The decision of the next stage."""
        raise NotImplementedError

    def state(self) -> dict[str, np.ndarray]:
        """The arrays that determine the decision of the last stage, once it has been learned; empty
        where it is the one of Mitsuba's ``path``."""
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
        the effect is part of another learner's."""
        return None

    def shadow_test(self, law: Any) -> Learner:
        """A learner of a shadow test from the visibility that this one learns.

        Parameters:
            law: The :class:`~mitsuba_ext.transport.rejection_law.RejectionLaw` of the test.
        """
        raise NotImplementedError

    # ---- Where light paths are tried beside it ----

    @property
    def efficiency(self) -> float:
        """The efficiency of its decision in the pilots, relative to ``path``."""
        return 1.0

    @property
    def growth(self) -> float:
        """By what factor more samples are expected to raise :attr:`efficiency`."""
        return 1.0

    @property
    def learns_beside_light_paths(self) -> bool:
        """Whether :meth:`beside_light_paths` makes a learner."""
        return False

    def beside_light_paths(self, time: float) -> Learner:
        """A learner that begins with this one's decision, and learns from camera paths that bring
        less light from now on, because light paths bring the rest. ``time`` is the time of a
        sample, relative to ``path``."""
        raise NotImplementedError

    def start_again(self) -> Any | None:
        """The first decision of a learner that :meth:`beside_light_paths` has made."""
        raise NotImplementedError

    def set_variance(self, variance: float, trimmed: float) -> None:
        """Tells the variance of a sample of ``path`` with this decision, relative to the squared
        radiance of its pixel, as a better estimate has found it; and the same without the brightest
        contributions."""

    def __str__(self) -> str:
        """A summary of what was learned; empty if the summary of another learner covers it."""
        raise NotImplementedError
