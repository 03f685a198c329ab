"""Direct light of an environment by two-stage importance sampling."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.slots import read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.planning.technique import ParameterReader
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.two_stage_lights.parameters import TwoStageLights
from mitsuba_ext.techniques.weighted_points.connections import Connections


@registry.plugin
class TwoStage(WalkIntegrator):
    r"""
    .. _integrator-two_stage:

    Two-stage importance sampling (:monosp:`two_stage`)
    ---------------------------------------------------

    A path tracer that connects the first vertex of each path to several directions of the
    environment. It samples them in proportion to an estimate of the product of environment map and
    BSDF. It is :monosp:`composed_path` with :monosp:`two_stage_lights`, whose page has the details,
    and :monosp:`weighted_connections`.

    .. pluginparameters::

     * - light_samples
       - |int|
       - Number of connections of the first vertex, at most 1024. They share one partition of the
         map. (Default: 16)
     * - splits
       - |int|
       - Maximum number of times that a vertex divides rectangles of the map, in addition to the
         first division into eight rectangles. (Default: 16)
     * - vertices
       - |string|
       - Which vertices divide the map and have this many connections: the :monosp:`first`, or
         :monosp:`all`. (Default: first)
     * - visibility
       - |string|
       - How connections of first vertices take occlusion into account: not at all
         (:monosp:`unknown`), or by visibility maps that a pilot has learned, over random numbers
         (:monosp:`primary`) or over directions (:monosp:`world`). (Default: unknown)
     * - reallocated
       - |float|
       - With visibility maps: the share of the connections that the maps sample, 0 to 0.99.
         (Default: 0.9)
     * - pilot_spp
       - |int|
       - With visibility maps: number of pilot samples per pixel, at most an eighth of all samples
         (a quarter in short renders). They count towards the image. (Default: 4)
     * - save_learned, load_learned
       - |string|
       - With visibility maps: as in :class:`composed_path`. (Default: none)
     * - keep_learned
       - |bool|
       - With visibility maps: as in :class:`composed_path`. (Default: false)
     * - clamp_direct, clamp_indirect
       - |float|
       - **Biased**: the largest light of a sample, see :class:`composed_path`. 0 clamps nothing.
         (Default: 0)
     * - caustics
       - |string|
       - Whether paths also connect to lights through smooth glass and mirrors
         (:monosp:`manifold`, or :monosp:`bounded_manifold`, which is **biased**), as in
         :class:`composed_path`. (Default: scattered)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** you compare methods, or when most noise comes from an uneven map that lights
    rough metal, and the number of camera samples is limited for another reason. **Not when** time
    matters: in all eleven scenes measured with indirect light, it was less efficient than
    :monosp:`path`; its samples mostly have less error, but take longer by a larger factor. Do not
    use it for narrow lobes under an even sky either, for which BSDF samples are better. If the
    light comes through a small opening, :monosp:`visibility` helps, but :monosp:`composed_path`
    with :monosp:`next_event=contribution` and :monosp:`connections=16` was seven times as
    efficient.

    Participating media are refused (use :monosp:`volpath` or :monosp:`composed_path`). Gradients
    are not supported (use :monosp:`prb`); neither are scalar and polarized variants.

    Source: D. Cline, P. K. Egbert, J. F. Talbot, D. L. Cardon, *Two Stage Importance Sampling for
    Direct Lighting*, EGSR 2006 (= D. Cline, PhD dissertation, BYU, 2007, chapter 5).

    .. tabs::
        .. code-tab:: xml

            <integrator type="two_stage">
                <integer name="light_samples" value="32"/>
            </integrator>

        .. code-tab:: python

            'type': 'two_stage',
            'light_samples': 32
    """

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        light_samples = self.parameter(props, "light_samples", 16, minimum=1, maximum=1024)
        lights = TwoStageLights(self.reader(props))
        caustics = read_slot(self.name, props, "caustics")
        slots: dict[str, Any] = {"next_event": lights, "caustics": caustics}
        if light_samples > 1:
            values = {"count": light_samples, "vertices": lights.vertices}
            slots["connections"] = Connections(ParameterReader.of_defaults(self.name, **values))
        self.light_samples = light_samples
        self.fill(props, **slots)
