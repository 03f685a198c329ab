"""The base class of our integrators whose samples are random walks.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from ..planning import kept_learning, verdicts
from ..planning.costs import LEARNING_KERNELS
from ..planning.learner import Learner
from ..planning.pilots import most_samples, pilot_samples, stage_weights
from ..planning.planner import Estimators, LearningPlan, Planner
from ..planning.technique import ParameterReader, Setting, Technique, decisions_of
from ..rendering.camera import film_extent
from ..rendering.device import SampleBytes, device_of
from ..rendering.request import Request
from ..rendering.stages import ReportedSchedule, Schedule, Stage
from ..rendering.statistics import RenderStatistics
from ..scene.media import refuse_media, refuse_moving_grids
from ..startup.registry import variant_bound
from ..transport.decisions import Decisions
from ..transport.estimator import CameraRays, Estimator
from ..transport.observer import Observer
from ..transport.path_channels import PathChannels
from ..transport.path_decisions import SceneQuery
from ..transport.queries.scene import scene_query
from ..transport.walk import Walk
from .clamps import bias_by, clamped, read_clamps, refuse_expressions
from .learned_state import LearnedState
from .output_variables import OutputVariables
from .slots import BIDIRECTIONAL_SLOTS, SLOTS, check_together, refuse_media_in_slots
from .staged_integrator import NO_LIMIT, StagedIntegrator

#: Pilots are a quarter of all samples at most: with fewer samples per pixel, there is none.
_LEAST_SPP = 4


@variant_bound
class WalkIntegrator(StagedIntegrator):
    """An integrator whose samples are random walks.

    A subclass reads its own parameters and calls :meth:`fill` with the decisions of the walk that
    it replaces.

    .. pluginparameters::

     * - max_depth
       - |int|
       - Longest path in the image, -1 for no limit. 1 shows visible emitters only, 2 adds direct
         illumination, and so on. (Default: -1)
     * - rr_depth
       - |int|
       - Path depth at which Russian roulette on the throughput begins. (Default: 5)
     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: false)
     * - (Common parameters)
       - |float|
       - Those of :class:`StagedIntegrator`: timeout, checkpoint.
     * - aovs
       - |string|
       - Arbitrary output variables, in the syntax of Mitsuba's :monosp:`aov` integrator, such as
         :monosp:`depth:depth,nn:sh_normal`. Besides Mitsuba's types, there are named passes
         (:monosp:`direct`, :monosp:`caustics`, …), light path expressions
         (:monosp:`key:C.*<L.'key'>`), a channel for each light group
         (:monosp:`groups:light_groups`), and masks: the types :monosp:`object_id`,
         :monosp:`material_id`, :monosp:`cryptomatte_object` and :monosp:`cryptomatte_material`.
         (Default: none)

    Where something learns, also ``pilot_spp``, ``save_learned``, ``load_learned`` and
    ``keep_learned``; see :class:`composed_path`.

    Attributes:
        has_light_paths (bool): Whether it traces light paths besides camera paths.
        can_clamp (bool): Whether it has the parameters ``clamp_direct`` and ``clamp_indirect``.
        sees_media (bool): Whether it renders participating media. If not, it refuses them.
        light_paths_see_media (bool): Whether its light paths, if it has any, scatter in them.
        no_expressions (str): Why it cannot render light path expressions; empty if it can. The text
            ends a sentence in an error message.
        learned_state (LearnedState): Where it keeps what it learns.
        slots (dict[str, Technique]): What fills the slots of the walk.
        learns_if_long (bool): Whether short renders learn nothing, unless the scene gives
            ``pilot_spp``, or what is learned is saved or kept.
        learners (dict[str, Learner]): The learners of the last render, by slot.
        outputs (OutputVariables): The channels of the parameter ``aovs``.
    """

    has_light_paths = light_paths_see_media = can_clamp = learns_if_long = False
    sees_media = True
    no_expressions = ""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        read = self.reader(props)
        max_depth = read("max_depth", -1, minimum=-1, maximum=NO_LIMIT - 1)
        self.max_depth = max_depth if max_depth >= 0 else NO_LIMIT
        self.rr_depth = read("rr_depth", 5, minimum=1, maximum=NO_LIMIT)
        self.clamps = read_clamps(self.name, props, read, self.can_clamp)
        self.aovs = read("aovs", "")
        self.outputs = OutputVariables(self.name, self.aovs, self.no_expressions)
        if self.outputs.has_expressions:
            refuse_expressions(self.name, self.clamps)
        self.slots: dict[str, Technique] = {}
        self.learners: Mapping[str, Learner] = {}
        self._pilot_spp: int | None = None
        self._asks_for_pilots = False
        self.learned_state = LearnedState(self.name)

    # ---- What a subclass calls ----

    def reader(
        self, props: mi.Properties, names: Mapping[str, str] | None = None, **defaults: Any
    ) -> ParameterReader:
        """Reads the parameters of a technique from the parameters of the integrator. ``names`` are
        the integrator's names where they differ, ``defaults`` the integrator's own defaults."""
        return ParameterReader(self.name, props, names, **defaults)

    def fill(self, props: mi.Properties, **slots: Technique | None) -> None:
        """Fills slots of the walk; ``None`` leaves a slot to Mitsuba's choice. If a decision
        learns, reads the common parameters ``pilot_spp``, ``save_learned``, ``load_learned`` and
        ``keep_learned``.

        Raises:
            TypeError, ValueError: Two decisions exclude each other, or a parameter is wrong.
        """
        known = (*SLOTS, *BIDIRECTIONAL_SLOTS)
        self.slots = {slot: slots[slot] for slot in known if slots.get(slot) is not None}
        check_together(self.name, self.slots, self.has_light_paths)
        wishes = [p.pilot_spp for p in self.slots.values() if p.pilot_spp]
        if wishes:
            read = self.reader(props)
            self._asks_for_pilots = read.is_given("pilot_spp")
            self._pilot_spp = read("pilot_spp", max(wishes), minimum=0)
            self.learned_state = LearnedState.read(self.name, read)

    def parameters(self) -> dict[str, Any]:
        pilots = {} if self._pilot_spp is None else {"pilot_spp": self._pilot_spp}
        if self._least_samples:
            pilots["learns_from"] = f"{self._least_samples} samples"
        return {
            **super().parameters(), **self._described_slots(), **pilots,
            **self.learned_state.parameters(),
        }  # fmt: skip

    # ---- What the render calls ----

    @property
    def can_learn(self) -> bool:
        """Whether it takes pilots, and can learn something that other renders can load."""
        return bool(self._pilot_spp)

    def plan_learning(
        self, request: Request, spp: int, kernels: float = math.inf
    ) -> LearningPlan:
        scene, sensor = request.scene, request.sensor
        self.learned_state.check_target(request)
        if self.learned_state.loads(request):
            made_by = self._learned_by(sensor)
            return LearningPlan(restore=lambda: self.learned_state.loaded(request, made_by))
        if self.max_depth < 2:
            return LearningPlan()
        pixel_count = math.prod(film_extent(sensor.film()))
        is_kept = self.learned_state.target(request) or self.learned_state.keep
        least = 0 if is_kept else self._least_samples
        if pixel_count * spp < least:
            return LearningPlan(remark=f"nothing: there are fewer than {least} samples")
        most = self.most_pilot_samples(pixel_count, spp)
        pilots = pilot_samples(self.slots, scene, pixel_count, spp, self._pilot_spp or 0, most)
        if self.learned_state.keep:
            kept = kept_learning.find(scene, self._learned_by(sensor))
            if kept is not None and sum(pilots) <= kept.pilot_spp:
                return LearningPlan(restore=kept.arrays)
        if kernels < LEARNING_KERNELS:
            return LearningPlan(remark="nothing: the time limit is too short")
        is_short = self._pilot_spp and spp < _LEAST_SPP
        remark = f"nothing: {spp} spp are too few" if is_short else ""
        return LearningPlan(tuple(pilots), remark)

    def most_pilot_samples(self, pixel_count: int, spp: int) -> int:
        """The most pilot samples per pixel of a render with ``spp`` of them."""
        return most_samples(pixel_count, spp)

    @property
    def _least_samples(self) -> int:
        """The number of samples of a render from which on it learns."""
        if not self.learns_if_long or self._asks_for_pilots or not self._pilot_spp:
            return 0
        return verdicts.least_samples(device_of(mi.Float).is_gpu)

    def pace_stage(self, request: Request, spp: int) -> Stage | None:
        caustics = self.slots.get("caustics")
        if self.has_light_paths or (caustics is not None and not caustics.tries):
            # Camera paths alone would miss the light of some lights, and are much faster
            return None
        # Where maps help much, samples without them are worth less
        doubles = any(t.doubles and t.can_learn(request.scene, 1) for t in self.slots.values())
        weight = stage_weights((1, spp - 1))[0] if doubles else 1.0
        walk = Walk(
            self.max_depth, self.rr_depth, self.hide_emitters, query=self.query(request.scene),
            **self.clamps, channels=self.channels,
        )  # fmt: skip
        return Stage(walk, weight=weight)

    @property
    def sample_cost(self) -> int:
        return max((parameters.sample_cost for parameters in self.slots.values()), default=1)

    @property
    def sample_bytes(self) -> SampleBytes:
        return SampleBytes(max((t.sample_bytes for t in self.slots.values()), default=0))

    @property
    def channel_bytes(self) -> int:
        return 0 if self.channels is None else self.channels.sample_bytes

    def samples_per_set(self, spp: int) -> int:
        return max((t.samples_per_set(spp) for t in self.slots.values()), default=1)

    @property
    def needs_equal_samples(self) -> str:
        for slot, technique in self.slots.items():
            if technique.needs_equal_samples:
                return technique.needs_equal_samples.format(slot=slot)
        return ""

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: LearningPlan
    ) -> Schedule:
        planner = self.planner(
            request, samples, learning, self.estimators(request, sum(samples), learning)
        )
        return ReportedSchedule(planner, self._report_clamps) if self.bias else planner

    @property
    def bias(self) -> str:
        """How the image is biased by parameters that trade bias for noise; empty if it is not."""
        return bias_by(self.clamps)

    def _report_clamps(self, statistics: RenderStatistics) -> None:
        statistics.add_learned(f"{self.bias}; the image is biased")

    def planner(
        self, request: Request, samples: tuple[int, ...], learning: LearningPlan,
        estimators: Estimators,
    ) -> Planner:  # fmt: skip
        """The planner of a render. ``estimators`` makes the estimators of stages."""
        *pilots, _rest = samples
        made_by = self._learned_by(request.sensor)
        # A restored state needs no pilots, but learners to restore it: these need a pilot_spp > 0
        pilot_spp = sum(pilots) if learning.restore is None else self._pilot_spp or 1
        setting = Setting(
            request.scene, request.sensor, request.seed, self.max_depth, self.rr_depth,
            sum(samples), pilot_spp, request.is_timed, self.name, techniques=self.slots,
        )  # fmt: skip
        planner = Planner(
            self.slots, setting, samples, estimators,
            Decisions(query=self.query(request.scene)), learning,
            self.learned_state.savers(request, made_by, sum(pilots)),
        )  # fmt: skip
        self.learners = planner.learners
        return planner

    def _learned_by(self, sensor: mi.Sensor) -> str:
        """On what, besides the scene, learned states depend."""
        slots = [f"{slot} = {text}" for slot, text in self._described_slots().items()]
        # What pays depends on the length of paths, and a guide serves a number of their bounces
        common = self.common_parameters()
        depths = [f"{key} = {common[key]}" for key in ("max_depth", "rr_depth")]
        # The tables of some decisions have an entry for each pixel
        width, height = film_extent(sensor.film())
        return ", ".join([*slots, *depths, f"film = {width}x{height}"])

    def estimators(self, request: Request, spp: int, learning: LearningPlan) -> Estimators:
        """The function that makes the estimators of the stages of a render with ``spp`` samples per
        pixel: :meth:`estimator`."""
        return self.estimator

    def estimator(self, decisions: Decisions, observer: Observer | None = None) -> Estimator:
        """The estimator of a stage without light paths: :meth:`walk`, with what the slot
        ``caustics`` adds to it."""
        walk = self.walk(decisions, observer)
        return walk if decisions.caustics is None else decisions.caustics.around(walk)

    def walk(
        self, decisions: Decisions = Decisions(), observer: Observer | None = None  # noqa: B008
    ) -> Walk:
        """A walk with this integrator's parameters and these decisions."""
        observed = {} if observer is None else {"observer": observer}
        return Walk(
            self.max_depth, self.rr_depth, self.hide_emitters, **decisions.of_walk(), **observed,
            **self.clamps, channels=self.channels,
        )  # fmt: skip

    # ---- What Mitsuba calls ----

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """One sample, for integrators that nest this one and draw its samples (``moment``; ``aov``
        calls :meth:`render`). Nothing is learned there: each decision that needs a pilot falls
        back to its default.

        Raises:
            NotImplementedError: The integrator has light paths, or connects through casters.
        """
        caustics = self.slots.get("caustics")
        if caustics is not None and not caustics.tries:
            raise NotImplementedError(
                f'"{self.name}": the parameter "caustics" is "{caustics.name}", which connects all '
                f"samples of a pass at once: it cannot be nested in an integrator that asks for "
                f'single samples, such as "moment" or "aov"; leave the parameter out'
            )
        if self.has_light_paths:
            raise NotImplementedError(
                f'"{self.name}": light paths do not end where a ray begins: it cannot be nested '
                f'in an integrator that asks for single samples, such as "moment" or "aov"; '
                f'"variance" can hold it, and it has a parameter "aovs" of its own'
            )
        self.check_sampled()
        if self.masks:
            raise NotImplementedError(
                f'"{self.name}": the masks in "aovs" ({", ".join(kind for _, kind in self.masks)}) '
                f"are made from all samples of a pixel: render with this integrator itself, and "
                f"not in one that asks for single samples"
            )
        setting = Setting(
            scene, scene.sensors()[0], 0, self.max_depth, self.rr_depth, 1, plugin=self.name
        )
        self.look_at(scene)
        walk = self.walk(decisions_of(self.slots, setting, Decisions(query=self.query(scene))))
        sample = walk(scene, sampler, CameraRays(ray, medium=medium), mi.Bool(active))
        return sample.L, sample.valid, sample.aovs + self.sample_aovs(scene, sampler, ray)

    @property
    def channels(self) -> PathChannels | None:
        """The light path expressions of the render; ``None`` without any."""
        return self.outputs.channels

    @property
    def masks(self) -> tuple[tuple[str, str], ...]:
        return self.outputs.masks

    @property
    def has_expressions(self) -> bool:
        return self.outputs.has_expressions

    def look_at(self, scene):
        self.outputs.look_at(scene)

    def aov_names(self) -> list[str]:
        return self.outputs.names()

    @property
    def has_ray_aovs(self) -> bool:
        return len(self.aov_names()) > len(self.outputs.expression_names())

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        """The values of the channels that :meth:`aov_names` names, without the channels of light
        path expressions."""
        return self.outputs.ray_values(scene, sampler, ray)

    def common_parameters(self) -> dict[str, Any]:
        return {
            "max_depth": -1 if self.max_depth == NO_LIMIT else self.max_depth,
            "rr_depth": self.rr_depth,
            "hide_emitters": self.hide_emitters,
            **clamped(self.clamps),
            **super().common_parameters(),
            "aovs": self.aovs or "none",
        }

    # ---- Helpers ----

    def _described_slots(self) -> dict[str, str]:
        return {slot: decision.describe(self.slots) for slot, decision in self.slots.items()}

    def query(self, scene: mi.Scene) -> SceneQuery:
        """How rays are intersected with ``scene``.

        Raises:
            NotImplementedError: This integrator does not support something in ``scene``.
        """
        self._check_media(scene)
        return scene_query(scene)

    def _check_media(self, scene: mi.Scene) -> None:
        if self.has_light_paths and not self.light_paths_see_media:
            refuse_media(
                scene, f'"{self.name}", whose light paths do not scatter in a medium,',
                'use "bdpt", "sppm", "composed_path" or "volpath"',
            )  # fmt: skip
        if not self.sees_media:
            refuse_media(scene, f'"{self.name}"', 'use "composed_path" or "volpath"')
        refuse_media_in_slots(self.name, self.slots, scene)
        refuse_moving_grids(scene, f'"{self.name}"')
