"""The base class of integrators that take one number of the camera rays from weighted sets.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..decisions.camera.pixel_sets import PixelSets
from ..garbage import garbage_left_alone
from ..movers import check_motion_is_seen
from ..rendering.staged_integrator import NO_LIMIT, StagedIntegrator
from ..rendering.stages import OneStage, Schedule, Stage
from ..transport.estimator import CameraRays, Sample
from .camera_numbers import PURPOSES, WeightedNumbers, samples_per_set
from .decision_parameters import ParameterReader, Setting


class ReweightedCamera(StagedIntegrator):
    """Renders with a nested integrator, for camera rays of which one number (or two) comes from
    weighted sets.

    A subclass says what the numbers are for. Nested in each other, subclasses do their work
    together.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed, see :monosp:`weighted_numbers`:
         :monosp:`independent`, :monosp:`stratified`, :monosp:`latin_hypercube`, :monosp:`halton`,
         :monosp:`hammersley`, :monosp:`sobol`, :monosp:`lattice` or :monosp:`poisson_disk`.
         (Default: lattice)
     * - weights
       - |string|
       - Weights of the points, see :monosp:`weighted_numbers`: :monosp:`none`, :monosp:`torus`,
         :monosp:`unbiased` or :monosp:`voronoi` (slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit; kept as by :monosp:`composed_path`.
         With a limit, sets have at most 64 points, and the render ends after a whole set.
         (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours.

    Attributes:
        purpose: The attribute of :class:`CameraSamples` that is taken over.
    """

    purpose: str

    def __init__(self, props: mi.Properties) -> None:
        if "hide_emitters" in props:
            raise ValueError(
                f'"{props.plugin_name()}": "hide_emitters" is for the nested integrator to know'
            )
        super().__init__(props)
        reader = ParameterReader(self.name, props)
        self.numbers = WeightedNumbers(reader, PURPOSES[self.purpose].weights)
        self.nested = self._nested(props)

    # ---- What the base class asks for ----

    def pilots(self, scene: mi.Scene, pixel_count: int, spp: int) -> list[int]:
        return self.nested.pilots(scene, pixel_count, spp) if self._is_staged else []

    @property
    def sample_cost(self) -> int:
        return self.nested.sample_cost if self._is_staged else 1

    def samples_per_set(self, spp: int) -> int:
        return samples_per_set(spp, self.timeout > 0)

    def schedule(
        self, scene: mi.Scene, sensor: mi.Sensor, samples: tuple[int, ...], seed: int
    ) -> Schedule:
        if self._is_staged:
            # Sets of all purposes must be cut alike
            self.nested.timeout = self.timeout
            schedule = self.nested.schedule(scene, sensor, samples, seed)
        else:
            check_motion_is_seen(self.nested, scene)
            schedule = OneStage(_NestedEstimator(self.nested, sensor.get_medium()))
        setting = Setting(
            scene, sensor, seed, NO_LIMIT, NO_LIMIT, sum(samples), is_timed=self.timeout > 0
        )
        numbers = self.numbers.numbers(self.name, self.purpose, setting)
        return _Reweighted(schedule, self.purpose, numbers) if numbers else schedule

    def parameters(self) -> dict[str, Any]:
        nested = str(self.nested).replace("\n", "\n  ")
        return {**self.numbers.parameters(), "nested": nested}

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
        return hasattr(self.nested, "schedule")


def _purposes(integrator: mi.Integrator) -> list[str]:
    """What an integrator, and those that are nested in it, take from weighted sets."""
    if not hasattr(integrator, "purpose"):
        return []
    return [integrator.purpose, *_purposes(integrator.nested)]


class _Reweighted:
    """A schedule whose camera rays take some numbers from weighted sets.

    Parameters:
        nested: The schedule whose stages these are.
        purpose: What the numbers are for.
        numbers: The numbers.
    """

    def __init__(self, nested: Schedule, purpose: str, numbers: PixelSets) -> None:
        self._nested, self._purpose, self._numbers = nested, purpose, numbers

    def next_stage(self) -> Stage:
        stage = self._nested.next_stage()
        if not stage.is_scout:
            setattr(stage.camera, self._purpose, self._numbers)
        return stage


class _NestedEstimator:
    """Draws the samples of an integrator. All four wavelengths survive in it."""

    def __init__(self, nested: mi.SamplingIntegrator, medium: mi.Medium | None) -> None:
        self._nested, self._medium = nested, medium

    def __call__(
        self, scene: mi.Scene, sampler: mi.Sampler, rays: CameraRays, active: mi.Bool
    ) -> Sample:
        with garbage_left_alone():
            L, valid, aovs = self._nested.sample(scene, sampler, rays.ray, self._medium, active)
        return Sample(L, valid, aovs=aovs)
