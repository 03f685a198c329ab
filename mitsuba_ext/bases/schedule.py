"""The stages of a render whose decisions learn: a scout, pilots, and the last stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..planning.decision_parameters import DecisionParameters, Setting
from ..planning.learned_file import States
from ..planning.learner import Learner
from ..planning.scout import SCOUT_DEPTH, Scout
from ..rendering.camera_samples import CameraSamples
from ..rendering.stages import Stage
from ..techniques.swarming.parameters import Swarm, doubling_pilots, first_parts, stage_weights
from ..techniques.weighted_points.camera_numbers import WeightedNumbers
from ..transport.estimator import Estimator
from ..transport.observer import Observers
from ..transport.path_decisions import NoConnections
from ..transport.walk import Walk

#: Where each pilot has as many samples as all before it, pilots may have half of all samples from
#: this number of samples per pixel on, as they then cost little; below, a quarter.
_MANY_SAMPLES = 8

#: The most samples in a pass from which maps are learned: the learners of all maps together record
#: about 150 bytes for each sample.
_MAP_LANES = 1 << 21

#: Approximate number of paths of each of the first two pilots, which measure the benefit of
#: learning.
_TRIAL_PATHS = 1 << 17


def pilot_samples(
    slots: Mapping[str, DecisionParameters],
    scene: mi.Scene,
    pixel_count: int,
    spp: int,
    pilot_spp: int,
) -> list[int]:
    """The samples per pixel of each pilot.

    Pilots have at most a quarter of all samples, as more of them gain little; half where each pilot
    doubles the samples (``DecisionParameters.doubles``). The first two pilots are short trials: if
    learning does not pay off, little time has been spent. The later pilots already use what was
    learned from all before them.

    Parameters:
        slots: What fills the slots of the walk.
        scene: The scene.
        pixel_count: Sampled pixels of the film.
        spp: Samples per pixel of the render.
        pilot_spp: Samples per pixel of all pilots, as the scene asks for them.
    """
    samples = min(pilot_spp, spp // 4)
    learning = [p for p in slots.values() if p.pilot_spp and p.can_learn(scene, samples)]
    if not learning:
        return []
    if all(parameters.pilot_paths for parameters in learning):
        enough = max(parameters.pilot_paths for parameters in learning)
        # At least two samples of a pixel, to estimate their variance
        samples = min(samples, max(2, -(-enough // pixel_count)))
    if all(parameters.doubles for parameters in learning):
        return doubling_pilots(min(pilot_spp, spp // 2 if spp >= _MANY_SAMPLES else spp // 4))
    if samples < 3 or all(not parameters.tries for parameters in learning):
        return [samples]
    quarter = samples // 4 or 1
    trial = max(1, _TRIAL_PATHS // pixel_count)
    if 2 * trial > quarter:
        return [quarter, quarter, samples - 2 * quarter]
    rest = samples - 2 * trial
    return [trial, trial, quarter, rest - quarter]


class Schedule:
    """Makes the stages of one render. All learners observe the same pilots; each returns the
    decision of its own slot.

    Parameters:
        plugin: The integrator's name in errors and warnings.
        slots: What fills the slots of the walk.
        setting: What is rendered.
        stages: Samples per pixel of each stage: pilots, and the last one.
        estimator: Makes the estimator of a stage, with the integrator's parameters, from the
            decisions that differ from those of ``path``.
        query: How rays are intersected with the scene.
        restored: What an earlier render has learned (``Learner.state``, by slot): there are then
            no pilots. ``None`` to learn.
        savers: Called with what was learned, before the last stage.

    Attributes:
        learners: The learners, by slot.
        beside: Learners that learn from stages of their own, which somebody else makes: this
            schedule saves, restores and reports what they learn.
        decisions: The decisions of the next stage that differ from those of ``path``, by slot.
        camera: Chooses points of the aperture, times and wavelengths.
        remark: What statistics say if nothing was learned.
        estimator: The parameter.
    """

    def __init__(
        self,
        plugin: str,
        slots: Mapping[str, DecisionParameters],
        setting: Setting,
        stages: Sequence[int],
        estimator: Callable[..., Estimator],
        query: Any,
        restored: States | None = None,
        savers: Sequence[Callable[[Mapping[str, Mapping[str, np.ndarray]]], None]] = (),
    ) -> None:
        self._setting, self._pilot_count, self.estimator = setting, len(stages) - 1, estimator
        self._stages = list(stages)
        self.decisions: dict[str, Any] = {"query": query}
        self.learners: dict[str, Learner] = {}
        self.beside: dict[str, Learner] = {}
        self.camera, self.remark = CameraSamples(), ""
        for slot, parameters in slots.items():
            if isinstance(parameters, WeightedNumbers):
                setattr(self.camera, slot, parameters.numbers(plugin, slot, setting))
                continue
            decision = parameters.decision(setting)
            if decision is not None:
                self.decisions[slot] = decision
            if setting.max_depth > 1:
                learner = parameters.learner(setting, self.learners)
                if learner is not None:
                    self.learners[slot] = learner
        learns_maps = [isinstance(slots[slot], Swarm) for slot in self.learners]
        self._learns_maps, self._learns_only_maps = any(learns_maps), all(learns_maps)
        #: For each stage, the weight of its samples relative to those of the last stage
        self._weights = stage_weights(stages) if self._learns_maps else [1.0] * len(stages)
        self._restored, self._savers = restored, savers
        self._states: dict[str, dict[str, np.ndarray]] = {}
        self._scout: Scout | None = None
        self._finished_stages = -1

    def divide_first_stage(self, pixel_count: int) -> int:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        learns = self._pilot_count > 0 and self.learners and self._stages[0] == 1
        if not self._learns_only_maps or not learns:
            return 1
        parts = first_parts(pixel_count, sum(self._stages))
        self._pilot_count += parts - 1
        self._weights = stage_weights(self._stages, parts)
        return parts

    def next_stage(self) -> Stage:
        """See :class:`mitsuba_ext.rendering.stages.Schedule`."""
        learners = list(self.learners.values())
        if self._restored is not None:
            return self._restored_stage(self._restored)
        if self._scout is None and any(learner.wants_scout for learner in learners):
            self._scout = Scout()
            return self._scout_stage()
        self._finished_stages += 1
        if self._finished_stages == 0:
            p, n = self._scout.vertices() if self._scout else (mi.Point3f(), mi.Normal3f())
            for slot, learner in self.learners.items():
                self._replace(slot, learner.start(self._setting.scene, p, n))
        if self._finished_stages > 0 or self._pilot_count == 0:
            self._learn(is_last=self._finished_stages == self._pilot_count)
        return self.stage_again()

    def end_learning(self) -> None:
        """See :class:`mitsuba_ext.rendering.stages.EndingSchedule`."""
        self._pilot_count = self._finished_stages + 1

    @property
    def is_at_end(self) -> bool:
        """Has :meth:`next_stage` returned the last stage?"""
        return self._finished_stages >= self._pilot_count

    def stage_again(self) -> Stage:
        """The stage that :meth:`next_stage` has returned, with the decisions of now."""
        if self.is_at_end:
            return self._last_stage()
        observer = _one_observer(list(self.learners.values()))
        return Stage(
            self.estimator(observer=observer, **self.decisions),
            camera=self.camera,
            weight=self._weights[self._finished_stages],
            most_lanes=_MAP_LANES if self._learns_maps else 0,
            observer=observer,
        )

    def leave_out(self, slots: Sequence[str]) -> Callable[[], None]:
        """Decides as ``path`` in these slots from now on, and learns nothing more for them. If
        nothing else learns, this stage and all after it are as the last one. Returns a function
        that takes up again what was decided."""
        decisions, learners, camera = (
            {slot: x[slot] for slot in slots if slot in x}
            for x in (self.decisions, self.learners, vars(self.camera))
        )
        for learner in learners.values():
            learner.finish()
        for slot in slots:
            self.decisions.pop(slot, None)
            self.learners.pop(slot, None)
            if hasattr(self.camera, slot):
                setattr(self.camera, slot, None)
        if not self.learners:
            self._pilot_count = self._finished_stages

        def take_up_again() -> None:
            self.decisions.update(decisions)
            self.learners.update(learners)
            vars(self.camera).update(camera)
            if self._savers:
                self._states.update({slot: x.state() for slot, x in learners.items()})

        return take_up_again

    def _restored_stage(self, states: States) -> Stage:
        for slot, learner in self._everyone.items():
            if slot in states:
                self._replace(slot, learner.restore(self._setting.scene, states[slot]))
        for learner in self.learners.values():
            learner.finish()
        for slot in set(self._everyone) - set(states):  # they decide as ``path``
            self.learners.pop(slot, None)
            self.beside.pop(slot, None)
        if not states:
            self.remark = "nothing: an earlier render has found that nothing pays"
        return self._last_stage()

    @property
    def _everyone(self) -> dict[str, Learner]:
        return {**self.learners, **self.beside}

    def _last_stage(self) -> Stage:
        if self._savers:
            self._states.update({slot: x.state() for slot, x in self.beside.items()})
            known = {s: x for s, x in self._states.items() if x and s in self._everyone}
            for save in self._savers:
                save(known)
        learned = "; ".join(filter(None, map(str, self._everyone.values()))) or self.remark
        estimator = self.estimator(**self.decisions)
        most = getattr(estimator, "most_lanes", 0)
        effects = {slot: learner.effect for slot, learner in self._everyone.items()}
        effects = {slot: effect.as_dict() for slot, effect in effects.items() if effect}
        return Stage(estimator, learned, effects, camera=self.camera, most_lanes=most)

    def _scout_stage(self) -> Stage:
        depth = min(SCOUT_DEPTH, self._setting.max_depth)
        walk = Walk(
            depth, depth, next_event=NoConnections(), query=self.decisions["query"],
            observer=self._scout,
        )  # fmt: skip
        return Stage(walk, is_scout=True, observer=self._scout)

    def _learn(self, is_last: bool) -> None:
        for slot, learner in self.learners.items():
            self._replace(slot, learner.learn(self._setting.scene, is_last))
        if is_last:
            if self._savers:
                self._states = {slot: x.state() for slot, x in self.learners.items()}
            for learner in self.learners.values():
                learner.finish()

    def _replace(self, slot: str, decision: Any | None) -> None:
        if decision is None:
            return
        if hasattr(self.camera, slot):
            setattr(self.camera, slot, decision)
        else:
            self.decisions[slot] = decision


def _one_observer(learners: Sequence[Learner]) -> Any:
    return learners[0] if len(learners) == 1 else Observers(learners)
