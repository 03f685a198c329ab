"""NEE++: next event estimation that learns which shadow rays are worth tracing."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.decisions.light_sampling import METHODS, LightSampling
from mitsuba_ext.integrator import WalkIntegrator
from mitsuba_ext.learning.learner import Learner


@registry.plugin
class NEEPlusPlus(WalkIntegrator):
    r"""
    .. _integrator-neepp:

    Next event estimation++ (:monosp:`neepp`)
    -----------------------------------------

    A path tracer that learns, from its first samples, which pairs of voxels see each other, and
    rejects most of the shadow rays that would be blocked. Russian roulette keeps it unbiased.

    .. pluginparameters::

     * - grid
       - |int|
       - Voxels along each axis of the scene's bounding box. (Default: 16)
     * - refine
       - |int|
       - Random visibility tests added to each entry of the map in which the pilot saw a success,
         for the voxels with a light. (Default: 16)
     * - max_memory
       - |float|
       - Memory for the visibility map, in MiB. Where :monosp:`grid` needs more, a coarser grid is
         used, with a warning. (Default: 64)
     * - pilot_spp
       - |int|
       - Samples per pixel from which visibility is learned, at most a quarter of all. They count
         towards the image. With 0 nothing is learned and every shadow ray is traced. A sampler that
         is stratified over all samples may need a longer pilot, up to a sixteenth. (Default: 4)
     * - law
       - |string|
       - How the probability of tracing a shadow ray follows from the learned visibility V:
         :monosp:`affine` for min(1, slope · V + floor), :monosp:`paper` for max(V, 1e-4), as
         printed: it traces fewer rays and is much noisier. (Default: affine)
     * - slope
       - |float|
       - Slope of the affine law. (Default: 10)
     * - floor
       - |float|
       - Least probability of the affine law, 1e-6 to 1. (Default: 0.1)
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
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. The number of passes is fixed from the
         speed of the first pass after learning, so that stopping does not prefer fast samples. The
         pilot and that pass are always finished (and one more, if it had to compile its kernel);
         beyond that the time is kept as well as the speed is steady. (Default: -1)
     * - aovs
       - |string|
       - Arbitrary output variables, in the syntax of Mitsuba's :monosp:`aov` integrator, such as
         :monosp:`depth:depth,nn:sh_normal`. (Default: none)

    **Use it when** most shadow rays are blocked: light through a door or from other rooms, many
    lamps behind walls, and when a shadow ray is expensive. **Not when** the scene is open (it then
    costs the pilot's bookkeeping) or the difficulty lies elsewhere, in glossy or indirect light.

    Visibility is learned towards points in the scene's bounding box. Lights at infinity or outside
    of it are always tested; where there are no others, nothing is learned, and where hardly a
    shadow ray would be rejected, what was learned is not used. Participating media are ignored, as
    by :monosp:`path`. Gradients are not supported (use :monosp:`prb`), nor are scalar and polarized
    variants. Nested in :monosp:`moment` there is no pilot, so every shadow ray is traced.

    Source: J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, sections 3 to 4.1.

    .. tabs::
        .. code-tab:: xml

            <integrator type="neepp">
                <integer name="max_depth" value="8"/>
                <integer name="grid" value="16"/>
            </integrator>

        .. code-tab:: python

            'type': 'neepp',
            'max_depth': 8,
            'grid': 16
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        light_sampling = self.parameter(props, "light_sampling", "contribution", choices=METHODS)
        rejection = self.parameter(props, "rejection", True)
        self.next_event = LightSampling.from_properties(self, props, light_sampling, rejection)

    def decisions(self, scene: mi.Scene) -> dict[str, Any]:
        return self.next_event.decisions(scene)

    def pilots(self, scene: mi.Scene, spp: int) -> list[int]:
        return self.next_event.pilots(scene, spp) if self.max_depth > 1 else []

    def learners(self, scene: mi.Scene, samples: int) -> list[Learner]:
        return self.next_event.learners(scene, samples)

    def parameters(self) -> dict[str, Any]:
        return vars(self.next_event)
