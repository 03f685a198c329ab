"""The stages of a render that begins as ``path``, and tries light paths in between."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import mitsuba as mi

from ..estimators.light_paths.choice.light_paths import OF_CAMERA_PATHS
from ..rendering.camera_samples import CameraSamples
from ..rendering.stages import Stage
from ..techniques.guided_directions.learner import GuideLearner
from ..techniques.learned_lights.learner import LightMapLearner
from .learned_slots import CAMERA_NUMBERS
from .schedule import Schedule

if TYPE_CHECKING:
    from ..estimators.light_paths.choice.light_paths import LightPathTrial
    from ..estimators.light_paths.choice.photon_trial import PhotonTrial

#: Renders of fewer samples learn nothing: ``path`` takes less time for so many than the fixed cost
#: of learning, and a tenth of the time to compile the kernels of learning.
LEAST_SAMPLES = 1 << 18

#: After so many pilots, or all if there are fewer, comes the trial: they are enough to tell what
#: else is worth its time.
_PILOTS = 2

#: Pilots without light paths are left out of the image if these have less than this part of their
#: variance: at equal weights, a quarter of all samples then adds more noise than it removes.
_FAR_LESS = 0.4


#: The least gain for which light paths are worth the time to compile their kernels: they take as
#: long as two million samples of ``path``, which is divided by the number of renders that share
#: them, about four.
_MARGIN, _KERNELS = 1.1, 5e5

#: The efficiency of guides that are learned from all pilots, relative to that which short ones
#: predict (door_ajar: 1.8 and 1.4).
_GROWS = 1.25


class LightPathSchedule:
    """Adds a stage to a schedule in which light paths are tried, with the lights that were learned
    until then. If they pay, more than guided directions do, the stages after it use them; and where
    guides paid before, they are learned again from these stages, unless vertices are merged. Before
    the last stage, the trial reconsiders what it has chosen, as the pilots after it show the real
    variance of that.

    Parameters:
        inner: Makes the other stages.
        scene: The scene.
        pilots: Number of the other pilots.
        trial: Chooses.
        samples: Number of all samples of the render.
    """

    def __init__(
        self,
        inner: Schedule,
        scene: mi.Scene,
        pilots: int,
        trial: LightPathTrial | PhotonTrial,
        samples: int,
    ) -> None:
        self._inner, self._scene, self._trial = inner, scene, trial
        self._margin = _MARGIN + _KERNELS / samples
        self._place = min(_PILOTS, pilots)
        inner.beside["light_paths"] = trial
        self._next: Stage | None = None
        self._is_over = False
        self._take_up_again: Callable[[], None] | None = None

    def next_stage(self) -> Stage:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        if self._next is not None:
            return self._stage_after_trial()
        stage = self._inner.next_stage()
        if self._is_over:
            return self._measured_stage(stage)
        if stage.is_scout:
            return stage
        if self._place > 0:
            self._place -= 1
            return stage
        self._next, self._is_over = stage, True
        choice = self._trial.start(self._scene, mi.Point3f(), mi.Normal3f())
        decisions = {
            slot: decision for slot, decision in self._inner.decisions.items()
            if slot not in OF_CAMERA_PATHS
        }  # fmt: skip
        estimator = self._inner.estimator(light_paths=choice, **decisions)
        return Stage(
            estimator, camera=CameraSamples(), is_scout=True, pixels=self._trial.samples
        )

    def end_learning(self) -> None:
        """See :class:`mitsuba_ext.rendering.stages.EndingSchedule`."""
        if not self._is_over:
            self._is_over = True
            del self._inner.beside["light_paths"]
        self._inner.end_learning()

    def _stage_after_trial(self) -> Stage:
        stage, self._next = self._next, None
        guide = self._inner.learners.get("directions")
        is_guided = isinstance(guide, GuideLearner) and guide.guide and guide.guidance
        self._trial.rival = self._margin
        if is_guided:
            self._trial.guide_efficiency = guide.guidance.efficiency * _GROWS
            self._trial.rival *= self._trial.guide_efficiency
        for slot in CAMERA_NUMBERS:
            learner = self._inner.learners.get(slot)
            if learner is not None and (effect := learner.effect).is_kept:
                self._trial.rival /= max(effect.variance, 1e-3)
        choice = self._trial.learn(self._scene, is_last=True)
        if choice is None or choice.techniques.light_paths == 0:
            return self._measured_stage(stage)
        self._take_up_again = self._inner.leave_out(self._trial.leaves_out)
        lights = self._inner.learners.get("next_event")
        if isinstance(lights, LightMapLearner) and lights.removed is not None:
            lights.set_variance(*self._trial.predicted.of_image)
        # Going back needs no margin, and brings back guides that have not become better
        self._trial.rival /= self._margin * (_GROWS if is_guided else 1.0)
        if is_guided and self._trial.can_be_guided and not self._inner.is_at_end:
            # MIS weights are those of unguided paths, which light paths may have as well
            self._inner.learners["directions"] = guide.beside_light_paths(self._trial.chosen_cost)
            self._inner.decisions["directions"] = guide.guide
        self._inner.decisions["light_paths"] = choice
        stage = self._measured_stage(self._inner.stage_again())
        return replace(stage, forgets=self._trial.chosen_variance < _FAR_LESS)

    def _measured_stage(self, stage: Stage) -> Stage:
        """A stage after the trial, whose variance is measured; or, if it is the last one, that with
        what the trial chooses now."""
        promise = self._trial.promise
        if not self._inner.is_at_end:
            return stage if promise is None else replace(stage, images=promise.images)
        choice, forgets = self._trial.reconsider(self._time_of_camera_paths(), self._margin), False
        if choice is not None and self._take_up_again is not None:
            del self._inner.decisions["light_paths"]
            self._take_up_again()
        elif choice is not None:
            self._inner.leave_out(self._trial.leaves_out)
            self._inner.decisions["light_paths"] = choice
            forgets = self._trial.chosen_variance < _FAR_LESS
        return replace(self._inner.stage_again(), forgets=forgets)

    def _time_of_camera_paths(self) -> float:
        """The time of a camera path with what was learned for it, in units of that of ``path``."""
        effects = [
            learner.effect for slot, learner in self._inner.learners.items()
            if slot in OF_CAMERA_PATHS
        ]  # fmt: skip
        return math.prod(x.time for x in effects if x is not None and x.is_kept and x.time)
