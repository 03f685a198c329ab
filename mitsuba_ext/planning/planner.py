"""The planner: it makes the stages of a render whose decisions learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from ..rendering.device import SampleBytes, device_of
from ..rendering.plan import is_independent
from ..rendering.stages import Learning, Schedule, Stage
from ..rendering.statistics import RenderStatistics
from ..transport.decisions import Decisions
from ..transport.estimator import Estimator
from ..transport.observer import SCOUT_DEPTH, Observer, Observers, Scout
from ..transport.path_decisions import NoConnections
from ..transport.walk import Walk
from ..util.stored_arrays import StoredArrays
from . import verdicts
from .costs import LIGHT_PATH_KERNELS
from .learner import Learner, Pilot
from .pilots import first_parts, stage_weights, weights_by_share
from .technique import Setting, Technique
from .trial import Rival, Trial

#: A trial comes after this number of pilots, or after all if there are fewer: they are enough to
#: tell what else is worth its time.
_PILOTS_BEFORE_TRIAL = 2

#: Called with what was learned, by slot.
Saver = Callable[[Mapping[str, Mapping[str, np.ndarray]]], None]

#: Makes the estimator of a stage from its decisions and the observer of its samples.
Estimators = Callable[[Decisions, "Observer | None"], Estimator]


@dataclass(frozen=True)
class LearningPlan(Learning):
    """What a render learns, as its integrator has planned it.

    Attributes:
        remark: What statistics say if nothing was learned.
        restore: Returns what an earlier render has learned, by slot: there are then no pilots.
            ``None`` to learn.
        trial: Makes what is tried in a stage of its own, in a render with this number of samples
            per pixel; ``None`` if nothing is.
        tries: Whether there is time for the trial. If not, it is only restored.
    """

    remark: str = ""
    restore: Callable[[], Mapping[str, StoredArrays]] | None = None
    trial: Callable[[int], Trial] | None = None
    tries: bool = False


class Planner(Schedule):
    """Makes the stages of one render: a scout, pilots, a trial, and the last stage. All learners
    observe the same pilots; each returns the decision of its own slot.

    After the first pilots, a :class:`Trial` may be made in a stage of its own, with the decisions
    that do not have to find all light alone. If what it tries pays, by more than what was learned
    for camera paths, the stages after it use it: these decisions are left out, or learned again
    beside it. The later pilots show the real variance of what was chosen, and before the last
    stage the trial reconsiders.

    Parameters:
        techniques: What fills the slots of the walk.
        setting: What is rendered.
        stages: Samples per pixel of each stage: pilots, and the last one.
        estimator: Makes the estimator of a stage, with the integrator's parameters, from its
            decisions and the observer of its samples.
        decisions: The decisions of slots that no technique fills.
        learning: What the integrator has planned.
        savers: Called with what was learned, before the last stage.

    Attributes:
        learners: The learners, by slot.
        decisions: The decisions of the next stage.
    """

    def __init__(
        self,
        techniques: Mapping[str, Technique],
        setting: Setting,
        stages: Sequence[int],
        estimator: Estimators,
        decisions: Decisions,
        learning: LearningPlan,
        savers: Sequence[Saver] = (),
    ) -> None:
        self._techniques, self._setting, self._estimator = techniques, setting, estimator
        self._stages, self._pilot_count = list(stages), len(stages) - 1
        self.decisions = decisions
        self.learners: dict[str, Learner] = {}
        for slot, technique in techniques.items():
            of_slot = replace(setting, slot=slot)
            decision = technique.decision(of_slot)
            if decision is not None:
                self.decide(**{slot: decision})
            if setting.max_depth > 1:
                learner = technique.learner(of_slot, self.learners)
                if learner is not None:
                    self.learners[slot] = learner
        learning_ones = [techniques[slot] for slot in self.learners]
        self._doubles = any(technique.doubles for technique in learning_ones)
        self._only_doubles = all(technique.doubles for technique in learning_ones)
        recorded = max((t.bytes_per_sample for t in learning_ones), default=0)
        self._most_lanes = device_of(mi.Float).lanes(SampleBytes(recorded)) if recorded else 0
        #: For each stage, the weight of its samples relative to the last stage, whatever is learned
        self._weights = [1.0] * len(stages)
        if self._doubles:
            self._weights = stage_weights(stages)
        elif is_independent(setting.sensor) and any(t.tries for t in learning_ones):
            # Unequal weights would spoil the strata of other samplers
            self._weights = weights_by_share(stages)
        self._learning, self._savers = learning, savers
        self._states: dict[str, dict[str, np.ndarray]] = {}
        self._scout: Scout | None = None
        self._finished_stages = -1
        self._trial = None if learning.trial is None else learning.trial(setting.spp)
        self._is_tried = not learning.tries
        self._pilots_before = min(_PILOTS_BEFORE_TRIAL, self._pilot_count)
        samples = setting.pixel_count * setting.spp
        self._margin = verdicts.LIGHT_PATHS + LIGHT_PATH_KERNELS / samples
        self._rival = Rival()
        #: The stage after the trials, while these run
        self._next: Stage | None = None
        self._take_up_again: Callable[[], None] | None = None

    # ---- What the render calls ----

    def divide_first_stage(self, pixel_count: int) -> int:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        learns = self._pilot_count > 0 and self.learners and self._stages[0] == 1
        if not self._only_doubles or not learns or not self._is_tried:
            return 1
        parts = first_parts(pixel_count, sum(self._stages))
        self._pilot_count += parts - 1
        self._weights = stage_weights(self._stages, parts)
        return parts

    def next_stage(self) -> Stage:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        if self._learning.restore is not None:
            return self._restored_stage(self._learning.restore())
        if self._next is not None:
            return self._stage_after_trial()
        stage = self._next_pilot()
        if stage.is_scout or self._trial is None:
            return stage
        if self._is_tried:
            return self._checked_stage(stage)
        if self._pilots_before > 0:
            self._pilots_before -= 1
            return stage
        self._next, self._is_tried = stage, True
        return self._trial_stage()

    def end_learning(self) -> None:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        if not self._is_tried:
            self._is_tried, self._trial = True, None
        self._pilot_count = self._finished_stages + 1
        del self._weights[self._pilot_count : -1]

    def finish(self, statistics: RenderStatistics) -> None:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""

    # ---- Pilots ----

    @property
    def is_at_end(self) -> bool:
        """Whether the stage that was made last is the last one."""
        return self._finished_stages >= self._pilot_count

    def _next_pilot(self) -> Stage:
        """The next pilot, or the last stage."""
        if self._scout is None and any(x.wants_scout for x in self.learners.values()):
            self._scout = Scout()
            return self._scout_stage()
        self._finished_stages += 1
        if self._finished_stages == 0:
            p, n = self._scout.vertices() if self._scout else (mi.Point3f(), mi.Normal3f())
            for slot, learner in self.learners.items():
                self.decide(**{slot: learner.start(self._setting.scene, p, n)})
        if self._finished_stages > 0 or self._pilot_count == 0:
            self._learn()
        return self._stage()

    def _scout_stage(self) -> Stage:
        depth = min(SCOUT_DEPTH, self._setting.max_depth)
        walk = Walk(
            depth, depth, next_event=NoConnections(), query=self.decisions.query,
            observer=self._scout,
        )  # fmt: skip
        return Stage(walk, is_scout=True, observer=self._scout)

    def _learn(self) -> None:
        pilot = Pilot(self._setting.scene, self.is_at_end)
        for slot, learner in self.learners.items():
            self.decide(**{slot: learner.learn(pilot)})
        for slot in [slot for x in self.learners.values() for slot in x.replaces]:
            self.decide(**{slot: None})
            if slot in self.learners:
                self.learners.pop(slot).finish()
        if pilot.is_last:
            if self._savers:
                self._states = {slot: x.state() for slot, x in self.learners.items()}
            for learner in self.learners.values():
                learner.finish()

    def decide(self, **decisions: Any) -> None:
        """Sets decisions of the stages that follow, by slot."""
        self.decisions = replace(self.decisions, **decisions)

    def _stage(self) -> Stage:
        """The stage that comes next, with the decisions of now."""
        if self.is_at_end:
            return self._last_stage()
        observers = [learner.observer for learner in self.learners.values()]
        observer = observers[0] if len(observers) == 1 else Observers(observers)
        return Stage(
            self._estimator(self.decisions, observer),
            camera=self.decisions.camera,
            weight=self._weights[self._finished_stages],
            most_lanes=self._most_lanes,
            observer=observer,
        )

    # ---- The trial ----

    def _trial_stage(self) -> Stage:
        left_out = {slot: None for slot, t in self._techniques.items() if t.finds_all_light}
        decisions = replace(self.decisions, light_paths=self._trial.first_choice(), **left_out)
        return Stage(
            self._estimator(decisions, None), is_scout=True, pixels=self._trial.samples
        )

    def _stage_after_trial(self) -> Stage:
        """The stage that follows; another trial, if the small one has not made the choice."""
        trial = self._trial
        alone = {slot: x for slot, x in self.learners.items() if self._finds_all_light(slot)}
        again = {slot: x for slot, x in alone.items() if x.learns_beside_light_paths}
        efficiencies = {slot: x.efficiency * x.growth for slot, x in alone.items()}
        guides = math.prod(efficiencies[slot] for slot in again)
        others = math.prod(x for slot, x in efficiencies.items() if slot not in again)
        self._rival = Rival(self._margin * guides * others, guides)
        larger = trial.larger(self._rival)
        if larger is not None:
            self._trial = larger
            return self._trial_stage()
        stage, self._next = self._next, None
        choice = trial.choose(self._rival)
        if choice is None:
            stage = self._checked_stage(stage)
            return replace(stage, discards_earlier=trial.discards_pilots)
        self._take_up_again = self._leave_out()
        if trial.path_variance is not None:
            for learner in self.learners.values():
                learner.set_variance(*trial.path_variance)
        # Reverting compiles nothing new, so it needs no margin; the restored guides have not
        # learned since the trial
        grown = math.prod(x.growth for x in again.values())
        self._rival = replace(self._rival, efficiency=guides * others / grown)
        if trial.can_be_guided and not self.is_at_end:
            for slot, learner in again.items():
                self.learners[slot] = learner.beside_light_paths(trial.chosen_time)
                self.decide(**{slot: self.learners[slot].start_again()})
        self.decide(light_paths=choice)
        stage = self._checked_stage(self._stage())
        return replace(stage, discards_earlier=trial.discards_pilots)

    def _checked_stage(self, stage: Stage) -> Stage:
        """A stage after the trial, whose variance is measured; or, if it is the last one, the stage
        with what the trial chooses now."""
        trial = self._trial
        if not self.is_at_end:
            return stage if trial.check is None else replace(stage, images=trial.check.images)
        if trial.reconsider(self._rival) is not None:
            self.decide(light_paths=None)
            self._take_up_again()
        return self._stage()

    def _finds_all_light(self, slot: str) -> bool:
        return self._techniques[slot].finds_all_light

    def _leave_out(self) -> Callable[[], None]:
        """Decides as ``path`` from now on in the slots that the trial leaves out, and learns no
        more for them. If nothing else learns, this stage and all after it are as the last one.
        Returns a function that takes up again what was decided."""
        slots = [
            slot for slot in self._techniques
            if self._trial.leaves_out(slot, self._finds_all_light(slot))
        ]  # fmt: skip
        decisions = {slot: getattr(self.decisions, slot) for slot in slots}
        learners = {slot: self.learners.pop(slot) for slot in slots if slot in self.learners}
        for learner in learners.values():
            learner.finish()
        self.decisions = replace(self.decisions, **dict.fromkeys(slots))
        if not self.learners:
            self._pilot_count = self._finished_stages

        def take_up_again() -> None:
            self.decisions = replace(self.decisions, **decisions)
            self.learners.update(learners)
            if self._savers:
                self._states.update({slot: x.state() for slot, x in learners.items()})

        return take_up_again

    # ---- The last stage ----

    def _restored_stage(self, states: Mapping[str, StoredArrays]) -> Stage:
        for slot, learner in self._everyone.items():
            if slot in states:
                self.decide(**{slot: learner.restore(self._setting.scene, states[slot])})
        for learner in self.learners.values():
            learner.finish()
        for slot in set(self._everyone) - set(states):  # they decide as ``path``
            self.learners.pop(slot, None)
            if slot == "light_paths":
                self._trial = None
        remark = "" if states else "nothing: an earlier render has found that nothing pays"
        self._learning = replace(self._learning, remark=remark)
        return self._last_stage()

    @property
    def _everyone(self) -> dict[str, Learner]:
        return {**self.learners, **({} if self._trial is None else {"light_paths": self._trial})}

    def _last_stage(self) -> Stage:
        everyone = self._everyone
        if self._savers:
            if self._trial is not None:
                self._states["light_paths"] = self._trial.state()
            known = {slot: x for slot, x in self._states.items() if x and slot in everyone}
            for save in self._savers:
                save(known)
        learned = "; ".join(filter(None, map(str, everyone.values()))) or self._learning.remark
        estimator = self._estimator(self.decisions, None)
        most = getattr(estimator, "most_lanes", 0)
        effects = {slot: learner.effect for slot, learner in everyone.items()}
        effects = {slot: effect.as_dict() for slot, effect in effects.items() if effect}
        return Stage(
            estimator, learned, effects, camera=self.decisions.camera,
            weight=self._weights[self._finished_stages], most_lanes=most,
        )  # fmt: skip
