"""Directions that are guided in primary sample space."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.guided_directions.parameters import Guided


@registry.plugin
class GuidedDirectionsPlugin(DecisionPlugin):
    r"""
    .. _sampler-guided_directions:

    Guided directions (:monosp:`guided_directions`)
    -----------------------------------------------

    A decision for the slot :monosp:`directions` of :monosp:`composed_path`. It learns from the
    first samples which random numbers lead the BSDF to sample directions from which light comes,
    and draws these numbers more often. It is unbiased, needs no knowledge of materials and lights,
    and guides all BSDFs in the same way. :monosp:`pss_guided` is a path tracer with this decision.

    .. pluginparameters::

     * - regions
       - |string|
       - What a tree of samples belongs to. :monosp:`surfaces`: a voxel and a side of the surfaces
         in it, or a voxel of a medium; every bounce uses the tree of its place. :monosp:`tiles`: a
         tile of the film, as in the thesis; the sample of a path's first bounce decides which tree
         the second uses, and so on. (Default: surfaces)
     * - tile
       - |int|
       - Edge of a tile in pixels; accepted only with :monosp:`tiles`. (Default: 16)
     * - bounces
       - |int|
       - Maximum number of directions of a path that are guided, up to 64 (with tiles, up to 5).
         Later bounces that are not worth the time are not guided. (Default: 6; 2 with tiles)
     * - always_guide
       - |bool|
       - Whether to guide all :monosp:`bounces`, even if the pilots show that guiding does not pay.
         If so, images with different seeds, and the frames of an animation, are all rendered in the
         same way and with the same kernels. (Default: false)
     * - max_memory
       - |float|
       - Memory for what is recorded and learned, in MiB. If the pilots need more, they record only
         a part of their paths. The trees of tiles of a few pixels take additional memory. (Default:
         512)

    **Use it when** light arrives indirectly: through doors, windows and gaps, from lit corners, via
    mirrors and glossy objects. **Not when** most light is direct (then choose lights better, with
    :monosp:`learned_lights`), when an image has fewer than 16 samples per pixel, or for caustics of
    small lights seen through glass, which camera paths do not find.

    Each tree is a k-d tree over the two numbers with which a BSDF samples a direction. Its density
    is proportional to the mean light that paths found from that vertex on. If a cell has few
    samples, the density is drawn towards the mean of a larger neighbourhood. The density is mixed
    with uniform numbers. The second pilot draws from the trees of the first, and measures their
    gain. This decides the share of samples that trees draw (40, 60 or 80 %), and how many bounces
    are worth the time of guiding them. If no bounce is worth it, learning ends, and directions are
    sampled as in :monosp:`path`. With fewer than 3 pilot samples per pixel (:monosp:`pilot_spp` of
    the integrator), nothing is guided. After a render, :monosp:`integrator.statistics.learned`
    describes what was learned, and :monosp:`integrator.learners["directions"].guide` is the learned
    guide (see examples/learned_samples.py).

    In participating media, phase functions take the place of BSDFs. They scatter relative to the
    direction of the path, so that equal numbers lead to other directions in each path. The trees of
    media are therefore over directions in space, of which at least a fifth is drawn from the phase
    function. With tiles, the numbers of phase functions are guided like the numbers of BSDFs.

    With regions of surfaces, the distance at which a path scatters in a homogeneous medium is
    guided, too (:monosp:`flights` of :monosp:`composed_path`), and with it the probability that it
    scatters before the next surface. Both follow the radiance along the ray. What lamps send to the
    fog is computed in a grid of 64 x 64 x 64 voxels; what fog and surfaces scatter is learned. Half
    of the distances are drawn as by :monosp:`volpath`. Distances in grids (:monosp:`heterogeneous`)
    are not guided; the summary of what was learned says so.

    The number that chooses a lobe of the BSDF is not guided, and neither are mirrors and glass
    (with tiles they are, to no effect). With regions of surfaces, Russian roulette is learned as
    well (:monosp:`roulette` of :monosp:`composed_path`): it continues paths that are expected to
    find light, but that a roulette by throughput alone would end. Without it, guided paths would
    lose much of their gain. Nested in :monosp:`moment`, the integrator takes no pilot samples, and
    nothing is guided.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 2 (Eqs. 2.5 to 2.13, Algorithm 1): trees of
    film tiles. J. Vorba, J. Křivánek, *Adjoint-Driven Russian Roulette and Splitting in Light
    Transport Simulation*, 2016: roulette (without splitting). S. Herholz et al., *Volume Path
    Guiding Based on Zero-Variance Random Walk Theory*, 2019: directions and distances in media. K.
    Xu et al., *Volume Scattering Probability Guiding*, 2024: the probability of scattering. The
    regions of surfaces, the estimates, and the measurement of the gain are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="directions" type="guided_directions">
                    <integer name="bounces" value="4"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'directions': {
                'type': 'guided_directions',
                'bounces': 4
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:directions=[guided_directions:bounces=4]"
    """

    kind = Guided
