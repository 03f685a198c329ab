"""The random walk itself, with its decisions chosen in the scene."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.slots import SLOTS, read_slot
from mitsuba_ext.bases.walk_integrator import WalkIntegrator
from mitsuba_ext.startup import registry


@registry.plugin
class ComposedPath(WalkIntegrator):
    r"""
    .. _integrator-composed_path:

    Composed path tracer (:monosp:`composed_path`)
    ----------------------------------------------

    A path tracer whose sampling decisions are chosen in the scene file. Each of its slots holds one
    decision: a word, or a nested plugin with parameters of its own. With all defaults it is
    Mitsuba's :monosp:`path`, except that it traces no shadow ray for connections that cannot
    contribute. It uses the same random numbers and gives the same image, as long as one pass of two
    million samples is enough. When Mitsuba 3.9.1 merges rectangles of one material, it computes
    wrong bounds for the scene; sky and sun then leak through walls in :monosp:`path`, but not here.

    .. pluginparameters::

     * - directions
       - |string| or |decision|
       - Which random numbers choose the next direction of a path: :monosp:`uniform` numbers,
         :monosp:`guided` numbers, or a nested :monosp:`guided_directions`. With :monosp:`swarm`,
         maps as in :monosp:`swarm_path` choose between reflection and transmission. (Default:
         uniform)
     * - scattering
       - |string| or |decision|
       - What samples the next direction of a path: the :monosp:`bsdf`; with :monosp:`focal` or a
         nested :monosp:`focal_points`, also learned places through which light passes, such as
         keyholes and slits; with :monosp:`swarm`, also learned maps, at the first vertex that is
         not a mirror (see :monosp:`swarm_path`). (Default: bsdf)
     * - next_event
       - |string| or |decision|
       - Which light a vertex is connected to, and which point of it. Not learned: :monosp:`uniform`
         (as :monosp:`path` chooses), :monosp:`power` (in proportion to the lights' power),
         :monosp:`spatial` (by unoccluded contributions, per voxel) or a nested
         :monosp:`spatial_lights`, :monosp:`tree` (by a light tree: for many lights, and for meshes
         that are lights), :monosp:`linear` (by an estimate for each light at each vertex, at a cost
         that grows with the number of lights), :monosp:`resampled` (one of several
         candidates) or a nested :monosp:`resampled_lights`, :monosp:`two_stage` (directions of the
         environment by the product of BSDF and light) or a nested :monosp:`two_stage_lights`,
         :monosp:`portals` (directions through the portals of a scene) or a nested
         :monosp:`portal_lights`. Learned: :monosp:`triple_product` (as :monosp:`two_stage`,
         multiplied by the learned visibility), :monosp:`contribution`, :monosp:`visibility`, or a
         nested :monosp:`learned_lights`. (Default: uniform)
     * - light_numbers
       - |string|
       - Which random numbers choose the light and the point on it, at the first vertex that is
         connected to lights: :monosp:`uniform` numbers, or with :monosp:`swarm`, numbers from
         learned maps (see :monosp:`swarm_path`). It requires a :monosp:`next_event` that does not
         learn. (Default: uniform)
     * - roulette
       - |string|
       - Which paths Russian roulette continues, from :monosp:`rr_depth` on. :monosp:`throughput` is
         the rule of :monosp:`path`. With :monosp:`automatic`, and directions guided by regions of
         surfaces, the survival probability grows with the radiance that the guide expects the path
         to find, relative to the brightness of its pixel. In all other cases, or if pilot samples
         show that this does not pay, the rule is :monosp:`throughput`. (Default: automatic)
     * - flights
       - |string|
       - How far paths fly in homogeneous media before they scatter. :monosp:`transmittance` is the
         choice of :monosp:`volpath`. With :monosp:`automatic`, and directions guided by regions of
         surfaces, paths scatter more often where much light arrives (see
         :monosp:`guided_directions`). In all other cases, or if pilot samples show that this does
         not pay, the choice is :monosp:`transmittance`. (Default: automatic)
     * - connections
       - |string|, |int| or |decision|
       - How many points on lights the first vertex of a path is connected to: :monosp:`one`, a
         number (of points from a :monosp:`hammersley` set), or a nested
         :monosp:`weighted_connections`. (Default: one)
     * - mis
       - |string| or |decision|
       - How connections to lights, and BSDF samples that hit lights, are weighted: :monosp:`power`,
         :monosp:`balance`, :monosp:`cutoff`, :monosp:`maximum`, :monosp:`bsdf` or :monosp:`light`
         alone, or a nested :monosp:`mis_heuristic`. (Default: power)
     * - shadow_test
       - |string| or |decision|
       - Whether the shadow ray of a connection is traced: :monosp:`always`, by
         :monosp:`visibility_roulette` (learned), or by a nested :monosp:`visibility_roulette` with
         parameters. (Default: always)
     * - caustics
       - |string|
       - How paths find light that smooth glass, water or mirrors lead to a vertex. With
         :monosp:`scattered`, only scattered rays find it, and they rarely hit a small light. With
         :monosp:`manifold`, one vertex of each path is also connected to a light through one
         reflection, or one or two refractions, by Newton's method. Pilots learn where such chains
         begin. A sample takes 3 to 11 times as long as with :monosp:`path`. With
         :monosp:`automatic`, this is done where pilots predict that it pays (they may be wrong), in
         renders of two million samples or more, and in scenes with at most 16 such surfaces and
         without media.
         :monosp:`bounded_manifold` is **biased**: it ends the search for a chain after 64 trials,
         so that light that is rarely found makes no bright pixels, and is partly missing. The
         surfaces are meshes, spheres, rectangles, disks and cylinders that have a
         :monosp:`dielectric`, :monosp:`conductor` or :monosp:`roughdielectric` without bump, normal
         or opacity map. The roughness of rough glass has no texture, and is at most 0.1. Other
         surfaces, instances, and scenes that move or disperse light are left to scattering. Light
         of points and directions that passes more than two smooth surfaces is missing, as with
         :monosp:`scattered`. It refuses participating media, and other :monosp:`scattering` than
         :monosp:`bsdf`. (Default: scattered)
     * - aperture, time, wavelength
       - |string| or |decision|
       - Which random numbers choose the point on the aperture, the time, and the wavelengths of a
         camera ray. They come from the sensor's sampler (:monosp:`sampler`), from learned maps of
         film tiles (:monosp:`swarm`, see :monosp:`swarm_path`), from point sets with a pattern
         (:monosp:`sobol`, :monosp:`lattice`, …), or from a nested :monosp:`weighted_numbers`. The
         slot :monosp:`wavelength` needs a spectral variant. (Default: sampler)
     * - distance
       - |string|
       - Which random numbers choose the distance that a camera ray travels in a homogeneous medium.
         They come from the sensor's sampler (:monosp:`sampler`), or from learned maps
         (:monosp:`swarm`, see :monosp:`swarm_path`). (Default: sampler)
     * - pilot_spp
       - |int|
       - Number of pilot samples per pixel, from which decisions learn; at most an eighth of all
         samples (a quarter in short renders; half, if only :monosp:`swarm` learns). They count
         towards the image. The parameter is accepted only if a decision learns. With 0, nothing is
         learned. With a stratified sampler, pilots consist of whole passes, and can be longer.
         (Default: 64 with :monosp:`swarm`, 32 with guided directions or focal points, 4 if only
         :monosp:`triple_product` learns, otherwise 16)
     * - save_learned, load_learned
       - |string|
       - Names of files. The render saves all that it has learned to :monosp:`save_learned`. With
         :monosp:`load_learned`, it takes no pilot samples, but uses what a render of the same
         scene, with the same parameters and film size, has saved, even from another camera.
         (Default: none)
     * - keep_learned
       - |bool|
       - Whether to keep what is learned for later renders of this process (frames, notebooks). A
         later render of the same scene, with the same parameters and film size, then takes no pilot
         samples, even from another camera. It learns again if it would take more pilot samples than
         the earlier render. An image then depends on the renders before it. The parameter is
         accepted only if a decision learns. (Default: false)
     * - clamp_direct, clamp_indirect
       - |float|
       - **Biased.** Less noise, by clamping the light that a sample of a pixel may find: the direct
         light (all that an image with :monosp:`max_depth` 2 shows, visible lights included), and
         all other light. Where the mean over the channels of a sample's light is above the limit,
         that light is scaled to the limit. (Cycles, which has the same parameters, scales each
         contribution to a sample by itself.) The image then lacks light, mostly of caustics and of
         reflected lamps, and the noise that it came with. Limits are in units of radiance: begin
         with 10 times the brightness of the image. 0 clamps nothing. (Default: 0)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** you want :monosp:`path` with bounded memory, a time budget, statistics or
    progress, or want to combine techniques. **Not when** you need gradients (use
    :class:`composed_prb`), or a scalar or polarized variant.

    In scenes with participating media, it is :monosp:`volpath`: it supports homogeneous and grid
    media, all phase functions, index-matched surfaces, and cameras and lights in fog. There are
    three differences: Russian roulette follows the rule of :monosp:`path`; the transmittance of
    homogeneous media along shadow rays is computed instead of estimated, which gives less noise;
    and :monosp:`hide_emitters` also hides a light that the camera sees through fog. In such scenes,
    :monosp:`next_event` can be :monosp:`uniform`, :monosp:`power`, :monosp:`spatial`,
    :monosp:`tree`, :monosp:`portals`, :monosp:`contribution` or :monosp:`visibility`; the other
    choices need a surface and refuse the scene. A guide for :monosp:`directions` also guides where
    paths scatter in media. If the extinction of any medium differs between colours, each flight
    chooses the colour that samples its distance in proportion to the throughput, and all colours
    count in its density (spectral MIS, as in :monosp:`volpathmis`, in grids too). Lights at
    infinity should not shine into an unbounded medium. With Mitsuba's :monosp:`ldsampler`, images
    of media have errors of 1 to 2 %, also with :monosp:`volpath`. A medium that exists only inside
    an :monosp:`instance` is rendered, but plugins that do not support media do not notice it, and
    therefore do not refuse the scene.

    With :monosp:`next_event=tree`, a vertex goes down a tree over all lights, and takes a child of
    a node with a probability proportional to an estimate of what the child's lights contribute:
    power, distance, the normal of the surface, and where the lights shine. Nothing is learned and
    the cost grows with the logarithm of the number of lights. Each face of a mesh of at least 8
    faces is a light of its own, so that thousands of bulbs can be one mesh; textured meshes are
    whole. The estimates know nothing of occlusion: use :monosp:`neepp` where most lights are hidden
    and the render is long. With one light that is not such a mesh, it is :monosp:`uniform`.

    A scene file nests a decision as a :monosp:`sampler` with the name of the slot, because to
    Mitsuba, decisions are samplers. Every decision can be combined with every decision of the other
    slots, and the image stays unbiased (except with :monosp:`voronoi` weights). All decisions that
    learn share the same pilot passes: two short ones, which show whether learning pays, and one or
    two longer ones (only one pass, if only :monosp:`visibility_roulette` learns). When lights are
    learned, :monosp:`visibility_roulette` uses their map, and does not accept parameters for a map
    of its own. :monosp:`neepp`, :monosp:`pss_guided` and :monosp:`reweighted_direct` are this path
    tracer with some of these decisions preset.

    Source: the algorithms of Mitsuba's :monosp:`path` and :monosp:`volpath`; J. T. Kajiya, *The
    Rendering Equation*, 1986; E. Veach, PhD thesis, 1997, chapter 9 (multiple importance sampling);
    P. Shirley in H. W. Jensen et al., *Monte Carlo Ray Tracing*, SIGGRAPH 2003 course 44, section
    3.4 (:monosp:`linear`); A. Conty Estevez, C. Kulla, *Importance Sampling of Many Lights with
    Adaptive Tree Splitting*, HPG 2018 (:monosp:`tree`); J. Hanika, M. Droske, L. Fascione,
    *Manifold Next Event Estimation*, 2015, and T. Zeltner, I. Georgiev, W. Jakob, *Specular
    Manifold Sampling for Rendering High-Frequency Caustics and Glints*, 2020, and Z. Fan et al.,
    *Manifold Path Guiding for Importance Sampling Specular Chains*, SIGGRAPH Asia 2023
    (:monosp:`caustics=manifold`). The pages of the decisions name their own sources.

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

    can_clamp = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.fill(props, **{slot: read_slot(self.name, props, slot) for slot in SLOTS})

    def parameters(self) -> dict[str, Any]:
        defaults = {slot: next(iter(words)) for slot, words in SLOTS.items()}
        return {**defaults, **super().parameters()}
