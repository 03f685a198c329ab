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

    Renders depth of field with the nested integrator, but takes the points of the aperture from
    well distributed sets, which can be weighed by the cells of the points. Each pixel has a set of
    its own for all of its samples, moved at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - How they are weighed: :monosp:`none` (all alike), :monosp:`torus` (by the areas of periodic
         Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points that are folded,
         so that opposite edges need not be alike), or :monosp:`voronoi` (by cells that end at the
         border, as in the thesis: slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. Sets, which then have at most 64
         points, are kept whole. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours.

    **Use it when** the noise is that of defocus: bright or detailed things far from the focal
    plane. **Not when** it is that of the light on them; samples of the lens change nothing about
    that. Without an aperture (a :monosp:`perspective` sensor), the nested integrator goes on
    alone, and a warning says so.

    Sets have as many points as a pixel has samples, at most 1024 (then there are several for each
    pixel). The weights concern all channels, alpha and AOVs too. Other dimensions of a sample are
    those of the sensor's sampler. An integrator of ours that is nested learns as it does alone; its
    own timeout is ignored. Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.3; periodic cells, and that they
    are unbiased, are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="reweighted_lens">
                <string name="pattern" value="sobol"/>
                <integrator type="path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'reweighted_lens',
            'pattern': 'sobol',
            'nested': {
                'type': 'path',
                'max_depth': 8
            }
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.set_kind = SetKind(self.name, props, pattern="lattice", weights="none")
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
