"""The base class of Metropolis integrators.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..bidirectional.path_tracer import BidirectionalPathTracer
from ..composition.decision_parameters import DecisionParameters, Setting
from ..composition.light_side import LightSide
from ..composition.slots import read_slot
from ..composition.walk_integrator import WalkIntegrator
from ..rendering.batches import sample_count
from ..rendering.camera import check_takes_splats, find_sensor
from ..rendering.camera import develop as develop_film
from ..rendering.interrupts import deferred_interrupt
from ..rendering.stages import OneStage
from ..transport.estimator import CameraRays, Estimator, Sample
from ..transport.path_decisions import Weights
from ..transport.walk import Walk
from ..transport.without_direct import WithoutDirect
from .render import ChainRender, ChainSettings
from .target import ImageTarget

#: The largest share of the time limit for camera samples.
_CAMERA_SHARE = 0.25

#: Camera samples per pixel that only find alpha and output variables.
_ALPHA_SAMPLES = 16


@dataclass
class _OnlyAlpha:
    """Camera samples without radiance."""

    estimator: Estimator

    def __call__(self, scene, sampler, rays: CameraRays, active) -> Sample:
        sample = self.estimator(scene, sampler, rays, active)
        return replace(sample, L=dr.zeros(mi.Spectrum, dr.width(sample.L)))


class MetropolisIntegrator(WalkIntegrator):
    """An integrator that renders direct light with camera samples, and the rest with chains.

    .. pluginparameters::

     * - bidirectional
       - |bool|
       - Do chains sample the paths of :class:`bdpt` (else those of :monosp:`path`)? A mutation then
         costs about four times as much, and caustics of small lamps are found. (Default: true)
     * - direct_samples
       - |int|
       - Camera samples per pixel for visible lights and direct light, which :monosp:`path` finds
         well; the chains find the rest. −1 leaves all light to the chains. (Default: 16)
     * - chains
       - |int|
       - Chains, which run in parallel; there are no more than mutations. 0 stands for as many as
         suit the render: 16384, and more if each then makes 64 mutations. (Default: 0)
     * - next_event
       - |string| or |decision|
       - How points on lights are chosen, as in :class:`composed_path`; by a choice that learns
         nothing. (Default: that of :monosp:`path`)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs.

    Attributes:
        direct_samples: Camera samples per pixel; −1 where chains find all light.
        bidirectional: Do chains sample paths from both ends?
        chains: Chains that run in parallel; 0 for as many as suit the render.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.direct_samples = self.parameter(
            props, "direct_samples", 16, minimum=-1, maximum=1 << 20
        )
        if self.direct_samples == 0:
            raise ValueError(
                f'"{self.name}": "direct_samples" is 0; it must be positive, or -1 to leave direct '
                f"light to the chains"
            )
        self.bidirectional = self.parameter(props, "bidirectional", True)
        self.chains = self.parameter(props, "chains", 0, minimum=0, maximum=1 << 20)
        self.fill(props, next_event=self._unlearned(props, "next_event"))

    def _unlearned(self, props: mi.Properties, slot: str) -> DecisionParameters | None:
        parameters = read_slot(self.name, props, slot)
        if parameters is not None and parameters.pilot_spp:
            raise ValueError(
                f'"{self.name}": the parameter "{slot}" is "{parameters.name}", which learns from '
                f"pilots; chains need a choice that does not, such as \"spatial\""
            )
        return parameters

    def settings(self) -> ChainSettings:
        """The parameters of the chains."""
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        return {
            "bidirectional": self.bidirectional,
            "direct_samples": self.direct_samples,
            "chains": self.chains,
            **super().parameters(),
        }

    @property
    def _finds_direct(self) -> bool:
        return self.direct_samples > 0

    def schedule(self, scene, sensor, samples, seed) -> OneStage:
        """Of the camera samples."""
        setting = Setting(
            scene, sensor, seed, self.max_depth, self.rr_depth, sum(samples), 0, self.timeout > 0
        )
        if self._finds_direct:
            return OneStage(self._walk(setting, min(self.max_depth, 2)))
        return OneStage(_OnlyAlpha(self._walk(setting, min(self.max_depth, 1))))

    def _walk(self, setting: Setting, max_depth: int, **decisions: Any) -> Walk:
        chosen = {slot: p.decision(setting) for slot, p in self.slots.items()}
        decisions.update({slot: decision for slot, decision in chosen.items() if decision})
        return replace(self.walk(query=self._query(setting.scene), **decisions),
                       max_depth=max_depth)

    def _target(self, setting: Setting) -> ImageTarget | None:
        """What chains sample; ``None`` where they have nothing to find."""
        scene, sensor = setting.scene, setting.sensor
        least = 3 if self._finds_direct else 1
        if not scene.emitters() or self.max_depth < least:
            return None
        if not self.bidirectional or self.max_depth < 2:
            weights = WithoutDirect(Weights()) if self._finds_direct else Weights()
            walk = self._walk(setting, self.max_depth, weights=weights)
            return ImageTarget(scene, sensor, walk, setting.spp)
        side = LightSide.of(self.name, scene, sensor)
        walk = self._walk(setting, self.max_depth)
        chosen = self.slots.get("next_event")
        next_event = side.next_event(walk.next_event if chosen else None)
        if next_event:
            walk = replace(walk, next_event=next_event)
        tracer = BidirectionalPathTracer(
            walk, side.emission, side.sensor, 1, is_alone=True, skips_direct=self._finds_direct
        )
        return ImageTarget(scene, sensor, tracer, setting.spp, has_light_paths=True)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        start = time.perf_counter()
        sensor = find_sensor(scene, sensor)
        try:
            check_takes_splats(sensor.film())
        except NotImplementedError as error:
            raise NotImplementedError(f'"{self.name}": {error}') from None
        spp = self._check_spp(spp, sensor)
        seed = int(seed[0]) if isinstance(seed, mi.UInt32) else int(seed)
        setting = Setting(scene, sensor, seed, self.max_depth, self.rr_depth, spp)
        target = self._target(setting)
        self._render_camera_samples(scene, sensor, seed, target is not None)
        statistics, camera_spp = self.statistics, self.statistics.spp
        is_interrupted = False
        if target is not None and not self.is_cancelled:
            chains = ChainRender(
                self, target, self.settings(), seed, spp, camera_spp, statistics, start
            )
            with deferred_interrupt() as interrupt:
                chains.run(interrupt)
            is_interrupted = interrupt.is_set()
        statistics.seconds = time.perf_counter() - start
        image = develop_film(sensor.film(), develop, evaluate)
        if is_interrupted:
            raise KeyboardInterrupt
        return image

    def _check_spp(self, spp: int, sensor: mi.Sensor) -> int:
        from ..parameters import MOST_SPP

        if not 0 <= spp <= MOST_SPP:
            raise ValueError(
                f'"{self.name}": spp is {spp}; it must be 1 to {MOST_SPP}, or 0 for as many '
                f"as the sampler says"
            )
        return spp or sample_count(sensor, 0)

    def _render_camera_samples(self, scene, sensor, seed: int, has_chains: bool) -> None:
        """Leaves them in the film, and their statistics in ``self.statistics``."""
        report, timeout = self.progress, self.timeout
        if has_chains:
            self.progress = None
            self.timeout = timeout * _CAMERA_SHARE
        spp = self.direct_samples if self._finds_direct else _ALPHA_SAMPLES
        try:
            super().render(scene, sensor, seed, spp, develop=False, evaluate=False)
        finally:
            self.progress, self.timeout = report, timeout

    def sample(self, scene, sampler, ray, medium=None, active=True) -> Any:
        raise NotImplementedError(
            f'"{self.name}": chains have no single samples: it cannot be nested in an integrator '
            f'that asks for those, such as "moment" or "aov"; "variance" can hold it, and it has a '
            f'parameter "aovs" of its own'
        )
