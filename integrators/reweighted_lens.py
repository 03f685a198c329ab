"""Depth of field from weighted sets of lens points, around any integrator."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.decisions.camera_samples import WeightedLens
from mitsuba_ext.decisions.weighted_sets import SetKind
from mitsuba_ext.rendering import Stage
from mitsuba_ext.staged_integrator import StagedIntegrator
from mitsuba_ext.walk import PathSample

#: Points of a set, at most, and with a timeout.
_MOST_POINTS, _MOST_POINTS_TIMED = 1024, 64


@registry.plugin
class ReweightedLens(StagedIntegrator):
    r"""
    .. _integrator-reweighted_lens:

    Reweighted lens samples (:monosp:`reweighted_lens`)
    ---------------------------------------------------
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.set_kind = SetKind(self.name, props, pattern="stratified", weights="tent")
        self.nested = self._nested(props)

    def _nested(self, props: mi.Properties) -> mi.SamplingIntegrator:
        children = [child for _, child in props.objects()]
        if (
            len(children) != 1
            or not isinstance(children[0], mi.SamplingIntegrator)
            or isinstance(children[0], (mi.CppADIntegrator, type(self)))
        ):
            found = ", ".join(child.class_name() for child in children) or "none"
            raise ValueError(
                f'"{self.name}": exactly one integrator that samples camera rays, such as "path" '
                f'or "volpath", must be nested in it (none for gradients); found {found}'
            )
        return children[0]

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        return self.nested.pilots(scene, spp) if self._is_staged else []

    def samples_per_set(self, spp: int) -> int:
        most = _MOST_POINTS_TIMED if self.timeout > 0 else _MOST_POINTS
        return -(-spp // -(-spp // most))

    def stages(
        self, scene: mi.Scene, sensor: mi.Sensor, samples: list[int], seed: int
    ) -> Iterator[Stage]:
        if self._is_staged:
            stages = self.nested.stages(scene, sensor, samples, seed)
        else:
            stages = iter([Stage(_NestedWalk(self.nested, sensor.get_medium()))])
        if not sensor.needs_aperture_sample():
            mi.Log(
                mi.LogLevel.Warn,
                f'"{self.name}": the sensor has no aperture, and nothing is reweighted; use a '
                f'"thinlens".',
            )
            yield from stages
            return
        sets = self.set_kind.sets(self.samples_per_set(sum(samples)), 2, seed)
        camera = WeightedLens(sets, seed)
        for stage in stages:
            if not stage.is_scout:
                stage.camera = camera
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

    @property
    def _is_staged(self) -> bool:
        """Is the nested integrator one of ours, which can learn in pilots?"""
        return isinstance(self.nested, StagedIntegrator)


class _NestedWalk:
    """A walk that draws the samples of an integrator."""

    def __init__(self, nested: mi.SamplingIntegrator, medium: mi.Medium | None) -> None:
        self._nested, self._medium = nested, medium

    def __call__(self, scene, sampler, ray, active, pixel=None) -> PathSample:
        L, valid, aovs = self._nested.sample(scene, sampler, ray, self._medium, active)
        zero = dr.zeros(mi.UInt32)
        return PathSample(L, valid, zero, zero, zero, aovs)
