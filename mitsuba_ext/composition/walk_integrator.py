"""The base class of our integrators whose samples are random walks.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi

from ..decisions.learner import Learner
from ..decisions.query.moving_scene import scene_query
from ..decisions.scout import SCOUT_DEPTH, NoConnections, Scout
from ..movers import refuse_movers
from ..rendering import camera
from ..rendering.aovs import check_aovs
from ..rendering.render import Stage
from ..rendering.staged_integrator import NO_LIMIT, StagedIntegrator
from ..transport.observer import Observers
from ..transport.path_decisions import SceneQuery
from ..transport.walk import Walk


class WalkIntegrator(StagedIntegrator):
    """An integrator whose samples are random walks.

    A subclass reads its own parameters and says, in :meth:`decisions` and :meth:`learners`, which
    decisions of the walk it takes over. Common parameters:

    Parameters:
        max_depth (int): Longest path in the image, −1 for no limit, 1 for visible emitters only.
            Default: −1.
        rr_depth (int): Depth at which Russian roulette begins. Default: 5.
        hide_emitters (bool): Hide directly visible emitters. Default: false.
        timeout (float): Seconds after which to stop; 0 or less for no limit. Default: −1.
        aovs (str): Arbitrary output variables, as in Mitsuba's ``aov`` integrator
            (``"depth:depth,nn:sh_normal"``). Default: none.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        max_depth = self.parameter(props, "max_depth", -1, minimum=-1, maximum=NO_LIMIT - 1)
        self.max_depth = max_depth if max_depth >= 0 else NO_LIMIT
        self.rr_depth = self.parameter(props, "rr_depth", 5, minimum=1, maximum=NO_LIMIT)
        self.aovs = self.parameter(props, "aovs", "")
        self._aovs = self._aov_integrator(self.aovs)

    # ---- What a subclass says ----

    def stage(self, learned: str = "", **decisions: Any) -> Stage:
        """A stage whose walk has this integrator's parameters and the given decisions."""
        walk = Walk(self.max_depth, self.rr_depth, self.hide_emitters, **decisions)
        return Stage(walk, learned)

    def decisions(self, scene: mi.Scene, seed: int) -> dict[str, Any]:
        """The decisions that are taken over without learning, as parameters of :class:`Walk`;
        ``seed`` is that of the render."""
        return {}

    def learners(self, scene: mi.Scene, sensor: mi.Sensor, samples: int) -> list[Learner]:
        """Who learns from ``samples`` pilot samples (of all pixels together; with 0, only those who
        know something already)."""
        return []

    def stages(
        self, scene: mi.Scene, sensor: mi.Sensor, samples: list[int], seed: int
    ) -> Iterator[Stage]:
        """Between the stages, learners turn observations into tables."""
        width, height = camera.film_extent(sensor.film())
        decisions = {"query": self._query(scene), **self.decisions(scene, seed)}
        *pilots, _rest = samples
        learners = self.learners(scene, sensor, width * height * sum(pilots))
        p, n = mi.Point3f(), mi.Normal3f()
        if any(learner.wants_scout for learner in learners):
            scout = Scout()
            depth = min(SCOUT_DEPTH, self.max_depth)
            walk = Walk(
                depth, depth, next_event=NoConnections(), query=decisions["query"], observer=scout
            )
            yield Stage(walk, is_scout=True)
            p, n = scout.vertices()
        for learner in learners:
            decisions.update(learner.start(scene, p, n))
        observer = learners[0] if len(learners) == 1 else Observers(learners)
        for index in range(len(pilots)):
            yield self.stage(observer=observer, **decisions)
            for learner in learners:
                decisions.update(learner.learn(scene, is_last=index == len(pilots) - 1))
        if not pilots:
            for learner in learners:
                decisions.update(learner.learn(scene, is_last=True))
        yield self.stage("; ".join(map(str, learners)), **decisions)

    # ---- What Mitsuba calls ----

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """One sample, for integrators that nest this one and draw its samples (``moment``; ``aov``
        calls :meth:`render`). Nothing is learned there: each decision that needs a pilot falls
        back to its default."""
        decisions = {"query": self._query(scene), **self.decisions(scene, 0)}
        walk = self.stage(**decisions).walk
        sample = walk(scene, sampler, mi.Ray3f(ray), mi.Bool(active))
        return sample.L, sample.valid, self.sample_aovs(scene, sampler, ray)

    def aov_names(self) -> list[str]:
        return self._aovs.aov_names() if self._aovs else []

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        """The values of the channels that :meth:`aov_names` names."""
        if self._aovs is None:
            return []
        return self._aovs.sample(scene, sampler, ray, None, mi.Bool(True))[2]

    def common_parameters(self) -> dict[str, Any]:
        return {
            "max_depth": -1 if self.max_depth == NO_LIMIT else self.max_depth,
            "rr_depth": self.rr_depth,
            "hide_emitters": self.hide_emitters,
            **super().common_parameters(),
            "aovs": self.aovs or "none",
        }

    # ---- Helpers ----

    def _query(self, scene: mi.Scene) -> SceneQuery:
        """How rays meet ``scene``. The output variables are Mitsuba's, which knows no motion."""
        if self._aovs is not None:
            refuse_movers(scene, f'"{self.name}": the parameter "aovs"', "leave it out")
        return scene_query(scene)

    def _aov_integrator(self, aovs: str) -> mi.Integrator | None:
        check_aovs(self.name, aovs)
        return mi.load_dict({"type": "aov", "aovs": aovs}) if aovs else None
