"""The base class of integrators that take one number of the camera rays from weighted sets.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from ..decisions.camera.pixel_sets import PixelSets
from ..decisions.weighted_sets import WEIGHTS, SetKind
from ..garbage import garbage_left_alone
from ..movers import check_motion_is_seen
from ..rendering.render import Stage
from ..rendering.staged_integrator import StagedIntegrator
from ..transport.walk import PathSample

#: Points of a set, at most, and with a timeout.
_MOST_POINTS, _MOST_POINTS_TIMED = 1024, 64

#: Purposes of numbers: each has sets of its own.
_PURPOSES = ("aperture", "time", "wavelength")


class ReweightedCamera(StagedIntegrator):
    """Renders with a nested integrator, for camera rays of which one number (or two) comes from
    weighted sets. Common parameters are ``pattern``, ``weights``, ``timeout`` and the nested
    integrator.

    A subclass says what the numbers are for. Nested in each other, subclasses do their work
    together.

    Attributes:
        purpose: Attribute of :class:`CameraSamples` that is taken over.
        dimension: Of the sets.
        periods: See :class:`WeightedSets`.
        default_pattern, default_weights, accepted_weights: Of the parameters.
    """

    purpose: str
    dimension = 1
    periods = 1
    default_pattern = "lattice"
    default_weights = "none"
    accepted_weights = WEIGHTS

    def __init__(self, props: mi.Properties) -> None:
        if "hide_emitters" in props:
            raise ValueError(
                f'"{props.plugin_name()}": "hide_emitters" is for the nested integrator to know'
            )
        super().__init__(props)
        self.set_kind = SetKind(
            self.name, props, self.default_pattern, self.default_weights, self.accepted_weights
        )
        self.nested = self._nested(props)

    def reason_to_do_nothing(self, sensor: mi.Sensor) -> str | None:
        """Why the numbers do not matter, and what to do about it; ``None`` if they do."""
        raise NotImplementedError

    # ---- What the base class asks for ----

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        return self.nested.pilots(scene, spp) if self._is_staged else []

    @property
    def sample_cost(self) -> int:
        return self.nested.sample_cost if self._is_staged else 1

    def samples_per_set(self, spp: int) -> int:
        most = _MOST_POINTS_TIMED if self.timeout > 0 else _MOST_POINTS
        return -(-spp // -(-spp // most))

    def stages(
        self, scene: mi.Scene, sensor: mi.Sensor, samples: list[int], seed: int
    ) -> Iterator[Stage]:
        if self._is_staged:
            # Sets of all purposes must be cut alike
            self.nested.timeout = self.timeout
            stages = self.nested.stages(scene, sensor, samples, seed)
        else:
            check_motion_is_seen(self.nested, scene)
            stages = iter([Stage(_NestedWalk(self.nested, sensor.get_medium()))])
        reason = self.reason_to_do_nothing(sensor)
        if reason is not None:
            mi.Log(mi.LogLevel.Warn, f'"{self.name}" reweights nothing: {reason}')
            yield from stages
            return
        seeds = [seed, _PURPOSES.index(self.purpose)]
        count = self.samples_per_set(sum(samples))
        sets = self.set_kind.sets(count, self.dimension, seeds, self.periods)
        numbers = PixelSets(sets, seeds)
        for stage in stages:
            if not stage.is_scout:
                setattr(stage.camera, self.purpose, numbers)
            yield stage

    def parameters(self) -> dict[str, Any]:
        nested = str(self.nested).replace("\n", "\n  ")
        return {**vars(self.set_kind), "nested": nested}

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """A sample of the nested integrator: the ray is another's."""
        return self.nested.sample(scene, sampler, ray, medium, active)

    def aov_names(self) -> list[str]:
        return self.nested.aov_names()

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        return self.nested.sample_aovs(scene, sampler, ray) if self._is_staged else []

    # ---- Helpers ----

    def _nested(self, props: mi.Properties) -> mi.SamplingIntegrator:
        children = [child for _, child in props.objects()]
        if (
            len(children) != 1
            or not isinstance(children[0], mi.SamplingIntegrator)
            or isinstance(children[0], mi.CppADIntegrator)
            or self.purpose in _purposes(children[0])
        ):
            found = ", ".join(child.class_name() for child in children) or "none"
            raise ValueError(
                f'"{self.name}": exactly one integrator that samples camera rays, such as "path" '
                f'or "volpath", must be nested in it (none for gradients, and none in which a '
                f'"{self.name}" is nested already); found {found}'
            )
        return children[0]

    @property
    def _is_staged(self) -> bool:
        """Is the nested integrator one of ours, which can learn in pilots?"""
        # Not by class: once another variant is selected, the module's name is that one's class
        return hasattr(self.nested, "stages")


def _purposes(integrator: mi.Integrator) -> list[str]:
    """What an integrator, and those that are nested in it, take from weighted sets."""
    if not hasattr(integrator, "purpose"):
        return []
    return [integrator.purpose, *_purposes(integrator.nested)]


class _NestedWalk:
    """A walk that draws the samples of an integrator. All four wavelengths survive in it."""

    def __init__(self, nested: mi.SamplingIntegrator, medium: mi.Medium | None) -> None:
        self._nested, self._medium = nested, medium

    def __call__(
        self, scene, sampler, ray, active, pixel=None, hero_weight=1.0
    ) -> PathSample:
        with garbage_left_alone():
            L, valid, aovs = self._nested.sample(scene, sampler, ray, self._medium, active)
        zero = dr.zeros(mi.UInt32)
        return PathSample(L, valid, zero, zero, zero, aovs)
