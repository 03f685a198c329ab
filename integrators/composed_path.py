"""The random walk itself, with its decisions chosen in the scene."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.composition.slots import SLOTS, read_slot
from mitsuba_ext.composition.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry


@registry.plugin
class ComposedPath(WalkIntegrator):
    r"""
    .. _integrator-composed_path:

    Composed path tracer (:monosp:`composed_path`)
    ----------------------------------------------

    A path tracer whose decisions are chosen in the scene. Each of its slots holds one decision: a
    word, or a nested plugin that has parameters of its own. With all defaults it is Mitsuba's
    :monosp:`path` (with the same random numbers and the same image, while one pass of two million
    samples is enough), but traces no shadow ray for connections that cannot contribute. Where
    Mitsuba 3.9.1 misjudges the bounds of a scene (rectangles of one material, which it merges), sky
    and sun leak through walls in :monosp:`path`, and not here.

    .. pluginparameters::

     * - directions
       - |string| or |decision|
       - Which random numbers choose the direction in which a path goes on: :monosp:`uniform` ones,
         :monosp:`guided` ones, or a nested :monosp:`guided_directions`. With :monosp:`swarm`, maps
         as in :monosp:`swarm_path` choose between reflection and transmission. (Default: uniform)
     * - scattering
       - |string|
       - Where a path goes on: where the :monosp:`bsdf` sends it, or at the first vertex that is no
         mirror also in directions of learned maps, :monosp:`swarm` (see :monosp:`swarm_path`).
         (Default: bsdf)
     * - next_event
       - |string| or |decision|
       - Which light a vertex is connected to, and which point of it. Not learned: :monosp:`uniform`
         (as :monosp:`path` chooses), :monosp:`power` (in proportion to the lights' power),
         :monosp:`spatial` (by unoccluded contributions, per voxel) or a nested
         :monosp:`spatial_lights`, :monosp:`linear` (by an estimate for each light at each vertex;
         its cost grows with their number), :monosp:`resampled` (one of several candidates) or a
         nested :monosp:`resampled_lights`, :monosp:`two_stage` (directions of the environment by
         the product of BSDF and light) or a nested :monosp:`two_stage_lights`, :monosp:`portals`
         (directions through the portals of a scene) or a nested :monosp:`portal_lights`. Learned:
         :monosp:`triple_product` (as :monosp:`two_stage`, and by what is visible),
         :monosp:`contribution`, :monosp:`visibility`, or a nested :monosp:`learned_lights`.
         (Default: uniform)
     * - light_numbers
       - |string|
       - Which random numbers choose the light and the point on it, at the first vertex that is
         connected to lights: :monosp:`uniform` ones, or those of learned maps, :monosp:`swarm` (see
         :monosp:`swarm_path`). It needs a :monosp:`next_event` that does not learn. (Default:
         uniform)
     * - roulette
       - |string|
       - Which paths go on from :monosp:`rr_depth` on. With :monosp:`automatic`, where directions
         are guided by regions of surfaces: paths are more likely to survive the more they are
         expected to bring, compared to their pixel, by what the guide has learned; elsewhere, and
         where pilots show that this does not pay, as with :monosp:`throughput`: by the rule of
         :monosp:`path`. (Default: automatic)
     * - connections
       - |string|, |int| or |decision|
       - To how many points of lights the first vertex of a path is connected: :monosp:`one`, a
         number (of points of a :monosp:`hammersley` set), or a nested
         :monosp:`weighted_connections`. (Default: one)
     * - mis
       - |string| or |decision|
       - How connections to lights and BSDF samples that run into them are weighed: :monosp:`power`,
         :monosp:`balance`, :monosp:`cutoff`, :monosp:`maximum`, :monosp:`bsdf` or :monosp:`light`
         alone, or a nested :monosp:`mis_heuristic`. (Default: power)
     * - shadow_test
       - |string| or |decision|
       - Whether the shadow ray of a connection is traced: :monosp:`always`, by
         :monosp:`visibility_roulette` (learned), or by a nested :monosp:`visibility_roulette` with
         parameters. (Default: always)
     * - aperture, time, wavelength
       - |string| or |decision|
       - Which numbers choose the point on the aperture, the time, and the wavelengths of a camera
         ray: those of the sensor's :monosp:`sampler`, those that maps of tiles have learned
         (:monosp:`swarm`, see :monosp:`swarm_path`), those of sets of a pattern (:monosp:`sobol`,
         :monosp:`lattice`, …), or those of a nested :monosp:`weighted_numbers`. wavelength needs a
         spectral variant. (Default: sampler)
     * - distance
       - |string|
       - Which numbers choose how far a camera ray flies in a homogeneous medium: those of the
         :monosp:`sampler`, or :monosp:`swarm` (maps, as :monosp:`swarm_path`). (Default: sampler)
     * - pilot_spp
       - |int|
       - Samples per pixel from which is learned, at most a quarter of all (half, where only
         :monosp:`swarm` learns). They count towards the image. Known only where something learns;
         with 0 nothing is learned. A sampler that is stratified over all samples may need longer
         pilots. (Default: 64 with :monosp:`swarm`, 32 with guided directions, 4 where only
         :monosp:`triple_product` learns, otherwise 16)
     * - save_learned, load_learned
       - |string|
       - Files. The first is written: what was learned, as a whole. The second is read in place of
         pilots: what a render of the same scene, with the same parameters and size of film, has
         saved. (Default: none)
     * - (Common parameters)
       - |several|
       - Those of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout, aovs,
         checkpoint.

    **Use it when** you want :monosp:`path` with passes of bounded memory, a time budget, statistics
    or progress, or to combine techniques. **Not when** you need gradients (use :monosp:`prb`), or a
    scalar or polarized variant.

    Where the scene has participating media, this is :monosp:`volpath`: homogeneous and grid media,
    all phase functions, index-matched surfaces, cameras and lights in fog. The rule of the roulette
    is that of :monosp:`path`, the transmittance of homogeneous media for shadow rays is computed,
    which leaves less noise, and :monosp:`hide_emitters` also hides a light that the camera sees
    through fog. :monosp:`next_event` can be :monosp:`uniform`, :monosp:`power`,
    :monosp:`spatial`, :monosp:`portals`, :monosp:`contribution` or :monosp:`visibility` there; the
    others need a surface and refuse the scene. :monosp:`directions` guided by regions of surfaces
    are guided at surfaces, and by tiles everywhere. As with :monosp:`volpath`, distances follow one
    of the colours: where these differ much, :monosp:`volpathmis` has less noise, and a medium that
    has no extinction at all in some of them is refused. Light from infinity should not shine into a
    medium without an end. Mitsuba's :monosp:`ldsampler` makes errors of 1 to 2 % in media, in
    :monosp:`volpath` too. A medium that only an :monosp:`instance` shows is rendered, but refused
    by none of those who do not see media.

    A scene nests a decision as a :monosp:`sampler`, which is what Mitsuba takes it for, under the
    name of the slot. Every decision goes with every decision of the other slots, and the image
    stays unbiased (but for :monosp:`voronoi` weights). All that learn share the same pilots: two
    short ones, which show whether learning pays, and one or two longer ones (a single one, if only
    :monosp:`visibility_roulette` learns). Beside learned lights, :monosp:`visibility_roulette` uses
    their map, and knows no parameters of a map of its own. :monosp:`neepp`, :monosp:`pss_guided`
    and :monosp:`reweighted_direct` are path tracers with some of these decisions, under one name
    each.

    Source: the algorithms are those of Mitsuba's :monosp:`path` and :monosp:`volpath`; J. T.
    Kajiya, *The Rendering Equation*, 1986; E. Veach, PhD thesis, 1997, chapter 9 (multiple
    importance sampling); P. Shirley in H. W. Jensen et al., *Monte Carlo Ray Tracing*, SIGGRAPH
    2003 course 44, section 3.4 (:monosp:`linear`). The pages of the decisions name theirs.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="directions" type="guided_directions">
                    <integer name="bounces" value="4"/>
                </sampler>
                <string name="next_event" value="contribution"/>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'directions': {
                'type': 'guided_directions',
                'bounces': 4
            },
            'next_event': 'contribution'

        .. code-tab:: bash

            mitsuba-ext compare scene.xml --time 10 path \
                "composed_path:directions=[guided_directions:bounces=4],next_event=contribution"
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.fill(props, **{slot: read_slot(self.name, props, slot) for slot in SLOTS})

    def parameters(self) -> dict[str, Any]:
        defaults = {slot: next(iter(words)) for slot, words in SLOTS.items()}
        return {**defaults, **super().parameters()}
