"""The base class of learners that have a stage of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from .learner import Learner
from .prediction_check import PredictionCheck


@dataclass(frozen=True)
class Rival:
    """What a trial has to beat.

    Attributes:
        efficiency: The efficiency of ``path`` with what was learned for it, relative to ``path``,
            times the margin that the trial needs.
        guides: The part of it that guided directions have, which may be kept beside light paths.
    """

    efficiency: float = 1.0
    guides: float = 1.0


class Trial(Learner):
    """Compares ``path`` with a way to render that leaves out other decisions, from the samples of a
    sparse stage that are no part of the image. Later pilots check the choice.

    Attributes:
        samples: A pixel for each sample of the stage.
        can_be_guided: Whether camera paths are guided beside what was chosen.
        check: Checks what was chosen; ``None`` if there is nothing to check.
        discards_pilots: Whether the pilots before the trial are left out of the image, because what
            was tried has far less variance. It does not depend on these pilots: if bright ones were
            more likely to be left out, the image would be too dark.
        chosen_time: The time of a sample of what was chosen, relative to ``path``.
        path_variance: The variance of a sample of ``path``, relative to the squared radiance of its
            pixel, and the same without the brightest contributions; ``None`` if it is not known.
    """

    samples: np.ndarray
    can_be_guided: bool
    check: PredictionCheck | None
    discards_pilots: bool
    chosen_time: float
    path_variance: tuple[float, float] | None = None

    def first_choice(self) -> Any:
        """The decision of the trial's stage."""
        raise NotImplementedError

    def larger(self, rival: Rival) -> Trial | None:
        """A trial of more samples that is to make the choice; ``None`` if this one can, because
        what it tries does not reach ``rival``, or because it is large."""
        return None

    def choose(self, rival: Rival) -> Any | None:
        """The decision of the stages after the trial; ``None`` for ``path``."""
        raise NotImplementedError

    def leaves_out(self, slot: str, finds_all_light: bool) -> bool:
        """Whether a decision is left out where what was tried is chosen. ``finds_all_light``: see
        :class:`~mitsuba_ext.planning.technique.Technique`."""
        return finds_all_light

    def reconsider(self, rival: Rival) -> Any | None:
        """The other decision, if the check has failed; ``None`` if nothing changes.

        Parameters:
            rival: What the choice has to beat now.
        """
        raise NotImplementedError

    def start(self, scene: mi.Scene, p: mi.Point3f, n: mi.Normal3f) -> Any:
        return self.first_choice()
