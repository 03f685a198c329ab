"""The base class of integrators that take one number of camera rays from weighted point sets.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.staged_integrator import NO_LIMIT
from mitsuba_ext.bases.wrapping_integrator import WrappingIntegrator
from mitsuba_ext.planning.technique import ParameterReader, Setting
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import ChangedSchedule, Learning, Schedule, Stage
from mitsuba_ext.startup.registry import variant_bound
from mitsuba_ext.techniques.weighted_points.camera_numbers import (
    PURPOSES,
    WeightedNumbers,
    samples_per_set,
)
from mitsuba_ext.techniques.weighted_points.pixel_sets import PixelSets


@variant_bound
class ReweightedCamera(WrappingIntegrator):
    """Renders with a nested integrator. One or two of the numbers that choose a camera ray come
    from weighted point sets.

    A subclass sets what the numbers choose. Different subclasses can be nested in each other, to
    combine their effects.

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
       - Seconds after which to stop, 0 or less for no limit; see :monosp:`composed_path`.
         With a limit, sets have at most 64 points, and the render ends after a whole set.
         (Default: -1)
     * - checkpoint
       - |string|
       - A folder in which the render is saved; see :class:`composed_path`. (Default: none)
     * - checkpoint_every
       - |string|
       - How often it is saved, such as :monosp:`60s` or :monosp:`100spp`. Only with
         :monosp:`checkpoint`. (Default: 60s)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours without chains.

    Attributes:
        purpose: The attribute of :class:`CameraSamples` that the point sets replace.
    """

    purpose: str

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        reader = ParameterReader(self.name, props)
        self.numbers = WeightedNumbers(reader, PURPOSES[self.purpose].weights)

    def accepts(self, nested: mi.SamplingIntegrator) -> bool:
        return self.purpose not in _purposes(nested)

    # ---- What the base class calls ----

    def samples_per_set(self, spp: int) -> int:
        return samples_per_set(spp, is_timed=True)

    @property
    def needs_equal_samples(self) -> str:
        return "its sets of numbers belong together"

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: Learning
    ) -> Schedule:
        schedule = super().schedule(request, samples, learning)
        setting = Setting(
            request.scene, request.sensor, request.seed, NO_LIMIT, NO_LIMIT, sum(samples),
            is_timed=request.is_timed, plugin=self.name, slot=self.purpose,
        )  # fmt: skip
        numbers = self.numbers.decision(setting)
        return _Reweighted(schedule, self.purpose, numbers) if numbers else schedule

    def parameters(self) -> dict[str, Any]:
        return {**self.numbers.parameters(), **super().parameters()}


def _purposes(integrator: mi.Integrator) -> list[str]:
    """The purposes for which an integrator, and those nested in it, use weighted sets."""
    nested = getattr(integrator, "nested", None)
    own = [integrator.purpose] if hasattr(integrator, "purpose") else []
    return own + (_purposes(nested) if nested is not None else [])


class _Reweighted(ChangedSchedule):
    """A schedule whose camera rays take some numbers from weighted sets.

    Parameters:
        inner: The schedule that makes the stages.
        purpose: What the numbers choose: an attribute of :class:`CameraSamples`.
        numbers: The numbers.
    """

    def __init__(self, inner: Schedule, purpose: str, numbers: PixelSets) -> None:
        super().__init__(inner)
        self._numbers = {purpose: numbers}

    def changed(self, stage: Stage) -> Stage:
        if stage.is_scout:
            return stage
        return replace(stage, camera=replace(stage.camera, **self._numbers))
