"""The base class of our integrators: Mitsuba's parameters, and errors where Mitsuba's are cryptic.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import mitsuba as mi

from . import camera, rendering
from .learning.learner import Learner, Observers
from .learning.scout import SCOUT_DEPTH, NoConnections, Scout
from .parameters import read_parameter
from .rendering import Stage
from .walk import Walk

_NO_DEPTH_LIMIT = 0xFFFFFFFF


class WalkIntegrator(mi.SamplingIntegrator):
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

    Attributes:
        progress: Called after each pass with the fraction done; it may raise or call ``cancel``.
        statistics: Of the last render (:class:`~mitsuba_ext.rendering.RenderStatistics`).
    """

    def __init__(self, props: mi.Properties) -> None:
        self.name = props.plugin_name()
        # Read before the base class reads them: its errors do not name the plugin
        self.timeout = self.parameter(props, "timeout", -1.0)
        self.parameter(props, "hide_emitters", False)
        super().__init__(props)
        max_depth = self.parameter(
            props, "max_depth", -1, minimum=-1, maximum=_NO_DEPTH_LIMIT - 1
        )
        self.max_depth = max_depth if max_depth >= 0 else _NO_DEPTH_LIMIT
        self.rr_depth = self.parameter(props, "rr_depth", 5, minimum=1, maximum=_NO_DEPTH_LIMIT)
        # Deprecated by Mitsuba, which says so in the log
        self.samples_per_pass = self.parameter(
            props, "samples_per_pass", _NO_DEPTH_LIMIT, minimum=1
        )
        self._aovs = self._aov_integrator(self.parameter(props, "aovs", ""))
        self.progress: Callable[[float], None] | None = None
        self.statistics = rendering.RenderStatistics()
        self.is_cancelled = False

    # ---- What a subclass says ----

    def stage(self, learned: str = "", **decisions: Any) -> Stage:
        """A stage whose walk has this integrator's parameters and the given decisions."""
        walk = Walk(self.max_depth, self.rr_depth, self.hide_emitters, **decisions)
        return Stage(walk, learned)

    def decisions(self, scene: mi.Scene) -> dict[str, Any]:
        """The decisions that are taken over without learning, as parameters of :class:`Walk`."""
        return {}

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        """The samples per pixel of each pilot stage, out of ``spp``; none where nothing learns."""
        return []

    def learners(self, scene: mi.Scene, sensor: mi.Sensor, samples: int) -> list[Learner]:
        """Who learns from ``samples`` pilot samples (of all pixels together; with 0, only those who
        know something already)."""
        return []

    def stages(
        self, scene: mi.Scene, sensor: mi.Sensor, samples: list[int]
    ) -> Iterator[Stage]:
        """Yields one stage for each entry of ``samples``: pilots, and the last one. What stands
        between two ``yield`` runs between the stages: learners turn observations into tables."""
        width, height = camera.film_extent(sensor.film())
        decisions = self.decisions(scene)
        *pilots, _rest = samples
        learners = self.learners(scene, sensor, width * height * sum(pilots))
        p, n = mi.Point3f(), mi.Normal3f()
        if any(learner.wants_scout for learner in learners):
            scout = Scout()
            depth = min(SCOUT_DEPTH, self.max_depth)
            walk = Walk(depth, depth, next_event=NoConnections(), observer=scout)
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

    def parameters(self) -> dict[str, Any]:
        """What ``str()`` shows besides the common parameters."""
        return {}

    # ---- What Mitsuba calls ----

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        self.is_cancelled = False
        return rendering.render(self, scene, sensor, seed, spp, develop, evaluate)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """One sample, for integrators that nest this one and draw its samples (``moment``; ``aov``
        calls :meth:`render`). Nothing is learned there: each decision that needs a pilot falls
        back to its default."""
        walk = self.stage(**self.decisions(scene)).walk
        sample = walk(scene, sampler, mi.Ray3f(ray), mi.Bool(active))
        return sample.L, sample.valid, self.sample_aovs(scene, sampler, ray)

    def aov_names(self) -> list[str]:
        return self._aovs.aov_names() if self._aovs else []

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        """The values of the channels that :meth:`aov_names` names."""
        if self._aovs is None:
            return []
        return self._aovs.sample(scene, sampler, ray, None, mi.Bool(True))[2]

    def cancel(self) -> None:
        """Ends the running render after the current pass (call it from ``progress`` or from another
        thread); the image of the finished passes is returned."""
        self.is_cancelled = True

    def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
        raise self.no_gradients()

    def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
        raise self.no_gradients()

    def to_string(self) -> str:
        parameters = {
            "max_depth": -1 if self.max_depth == _NO_DEPTH_LIMIT else self.max_depth,
            "rr_depth": self.rr_depth,
            "hide_emitters": self.hide_emitters,
            "timeout": self.timeout,
            **self.parameters(),
        }
        if self._aovs:
            parameters["aovs"] = ", ".join(self.aov_names())
        lines = ",\n".join(f"  {key} = {value}" for key, value in parameters.items())
        return f"{self.name}[\n{lines}\n]"

    # ---- Helpers ----

    def parameter(self, props: mi.Properties, key: str, default: Any, **accepted: Any) -> Any:
        """A parameter of the scene, checked: see :func:`mitsuba_ext.parameters.read_parameter`,
        which also says what ``accepted`` can be."""
        return read_parameter(self.name, props, key, default, **accepted)

    def no_gradients(self) -> NotImplementedError:
        """What to raise where gradients are asked for."""
        return NotImplementedError(
            f'"{self.name}" does not compute gradients: use an integrator made for that, such as '
            f'"prb".'
        )

    def _aov_integrator(self, aovs: str) -> mi.Integrator | None:
        return mi.load_dict({"type": "aov", "aovs": aovs}) if aovs else None
