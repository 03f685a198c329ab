"""The base class of integrators that draw the samples of a nested one.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi

from ..rendering.device import SampleBytes
from ..rendering.request import Request
from ..rendering.staged import is_staged
from ..rendering.stages import Learning, OneStage, Schedule, Stage
from ..scene.nesting import refuse_checkpoint
from ..scene.unseen import check_all_is_seen
from ..startup.garbage import garbage_left_alone
from ..startup.registry import variant_bound
from ..transport.estimator import CameraRays, Sample
from .staged_integrator import StagedIntegrator


@variant_bound
class WrappingIntegrator(StagedIntegrator):
    """An integrator that draws the samples of a nested one. The nested integrator is one of this
    package, which may learn in pilots, or one of Mitsuba's.

    Attributes:
        nested: The nested integrator.
    """

    def __init__(self, props: mi.Properties) -> None:
        if "hide_emitters" in props:
            raise ValueError(
                f'"{props.plugin_name()}": set "hide_emitters" in the nested integrator instead'
            )
        super().__init__(props)
        self.nested = self._nested(props)

    # ---- What a subclass overrides ----

    def accepts(self, nested: mi.SamplingIntegrator) -> bool:
        """Whether this integrator can be nested."""
        return True

    # ---- What a subclass calls ----

    def is_of_this_kind(self, nested: mi.SamplingIntegrator) -> bool:
        """Whether the nested integrator is an instance of the subclass."""
        # Not by the module's name: once another variant is selected, that is another class
        return isinstance(nested, type(self))

    def refuse_equal_samples(self, reason: str) -> None:
        """
        Parameters:
            reason: What this integrator cannot do with ``{nested}``, the nested integrator.

        Raises:
            ValueError: All pixels must get the same number of samples of the nested integrator.
        """
        if why := self.nested.needs_equal_samples if self._is_staged else "":
            name = f'"{self.nested.name}"'
            raise ValueError(f'"{self.name}": {reason.format(nested=name)}: {why}')


    # ---- What the base class calls ----

    def parameters(self) -> dict[str, Any]:
        nested = str(self.nested).replace("\n", "\n  ")
        return {**super().parameters(), "nested": nested}

    def plan_learning(
        self, request: Request, spp: int, kernels: float = math.inf
    ) -> Learning:
        if not self._is_staged:
            return Learning()
        return self.nested.plan_learning(request, spp, kernels)

    def pace_stage(self, request: Request, spp: int) -> Stage | None:
        return self.nested.pace_stage(request, spp) if self._is_staged else None

    @property
    def sample_cost(self) -> int:
        return self.nested.sample_cost if self._is_staged else 1

    @property
    def sample_bytes(self) -> SampleBytes:
        return self.nested.sample_bytes if self._is_staged else super().sample_bytes

    @property
    def channel_bytes(self) -> int:
        return self.nested.channel_bytes if self._is_staged else 0

    @property
    def needs_equal_samples(self) -> str:
        return self.nested.needs_equal_samples if self._is_staged else ""

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: Learning
    ) -> Schedule:
        if self._is_staged:
            return self.nested.schedule(request, samples, learning)
        check_all_is_seen(self.nested, request.scene)
        return OneStage(_NestedEstimator(self.nested, request.sensor.get_medium()))

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """A sample of the nested integrator, for a ray that another integrator has sampled."""
        self.check_sampled()
        return self.nested.sample(scene, sampler, ray, medium, active)

    @property
    def has_expressions(self) -> bool:
        return self._is_staged and self.nested.has_expressions

    def look_at(self, scene):
        if self._is_staged:
            self.nested.look_at(scene)

    def aov_names(self) -> list[str]:
        return self.nested.aov_names()

    @property
    def masks(self) -> tuple[tuple[str, str], ...]:
        return self.nested.masks if self._is_staged else ()

    @property
    def has_ray_aovs(self) -> bool:
        return self._is_staged and self.nested.has_ray_aovs

    def sample_aovs(self, scene, sampler, ray) -> list[mi.Float]:
        return self.nested.sample_aovs(scene, sampler, ray) if self._is_staged else []

    # ---- Helpers ----

    def _nested(self, props: mi.Properties) -> mi.SamplingIntegrator:
        children = [child for _, child in props.objects()]
        if (
            len(children) != 1
            or not isinstance(children[0], mi.SamplingIntegrator)
            or isinstance(children[0], mi.CppADIntegrator)
            or not self.accepts(children[0])
        ):
            found = ", ".join(child.class_name() for child in children) or "none"
            raise ValueError(
                f'"{self.name}": exactly one integrator that samples camera rays, such as "path" '
                f'or "volpath", must be nested in it (none for gradients, and none in which '
                f'"{self.name}" is nested already); found {found}'
            )
        nested = children[0]
        refuse_checkpoint(self.name, nested)
        if reason := getattr(nested, "missing_in_samples", ""):
            raise ValueError(
                f'"{self.name}" renders with the camera samples of the nested integrator, which '
                f'are not the whole image of "{nested.name}": {reason}'
            )
        return nested

    @property
    def _is_staged(self) -> bool:
        """Whether the nested integrator is one of ours, which can learn in pilots."""
        return is_staged(self.nested)


class _NestedEstimator:
    """Draws the samples of one of Mitsuba's integrators, which keep all four wavelengths."""

    def __init__(self, nested: mi.SamplingIntegrator, medium: mi.Medium | None) -> None:
        self._nested, self._medium = nested, medium

    def __call__(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        with garbage_left_alone():
            L, valid, aovs = self._nested.sample(scene, sampler, rays.ray, self._medium, active)
        return Sample(L, valid, aovs=aovs)
