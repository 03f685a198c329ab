"""Directions that are guided in primary sample space."""

from __future__ import annotations

from mitsuba_ext.composition.decision_plugin import DecisionPlugin
from mitsuba_ext.composition.directions import Guided
from mitsuba_ext.startup import registry


@registry.plugin
class GuidedDirectionsPlugin(DecisionPlugin):
    r"""
    .. _sampler-guided_directions:

    Guided directions (:monosp:`guided_directions`)
    -----------------------------------------------

    A decision for the slot :monosp:`directions` of :monosp:`composed_path`. It learns from the
    first samples which random numbers choose directions from which light comes, and draws these
    more often. It is unbiased, knows nothing of materials or of lights, and guides all BSDFs alike.
    :monosp:`pss_guided` is a path tracer with this decision.

    .. pluginparameters::

     * - regions
       - |string|
       - What has a tree of samples: :monosp:`surfaces` (voxels, and the sides of the surfaces in
         them; all bounces use the trees of the places where they happen), or :monosp:`tiles` (of
         the film, as in the thesis; the samples of a path's first bounce decide about the tree of
         the second, and so on). (Default: surfaces)
     * - tile
       - |int|
       - Edge of a tile in pixels; known only with :monosp:`tiles`. (Default: 16)
     * - bounces
       - |int|
       - How many directions of a path are guided, at most; those that do not pay are left out. At
         most 64, with tiles 5. (Default: 6; 2 with tiles)
     * - always_guide
       - |bool|
       - Guide all :monosp:`bounces`, also where the pilots show that it does not pay? Then images
         of different seeds, or the frames of an animation, are all made in the same way and by the
         same kernels. (Default: false)
     * - max_memory
       - |float|
       - Memory for what is recorded and learned, in MiB. Where the pilots need more, they record a
         part of their paths. Trees of tiles of a few pixels come on top. (Default: 512)

    **Use it when** light comes by way of other surfaces: through doors, windows and gaps, from lit
    corners, along mirrors and glossy things. **Not when** most light is direct (choose lights
    better then: :monosp:`learned_lights`), when an image has fewer than 16 samples per pixel, or
    for caustics of small lights seen through glass, which paths from the camera do not find.

    Each tree is a k-d tree over the two numbers by which a BSDF chooses a direction. Its density is
    the average that paths brought from there on, drawn to the average of larger surroundings where
    there are few samples, and mixed with uniform numbers. The second pilot draws from the trees of
    the first, and shows what they are worth. From that follows how much of the samples trees decide
    (40, 60 or 80 %), and how many bounces are worth the time of guiding them. If none is, learning
    ends there, and directions are those of :monosp:`path`. With fewer than 3 pilot samples per
    pixel (:monosp:`pilot_spp` of the integrator) nothing is guided. After a render,
    :monosp:`integrator.statistics.learned` tells what was found, and
    :monosp:`integrator.learners["directions"].guide` holds it (see examples/learned_samples.py).

    The number that chooses a lobe of the BSDF is not guided, and neither are mirrors and glass
    (with tiles they are, in vain). With regions of surfaces, Russian roulette is learned as well
    (:monosp:`roulette` of :monosp:`composed_path`): paths that the throughput alone would end where
    they matter go on, without which guided paths lose much of their gain. Nested in
    :monosp:`moment` there is no pilot, and nothing is guided.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 2 (Eqs. 2.5 to 2.13, Algorithm 1): trees of
    film tiles. J. Vorba, J. Křivánek, *Adjoint-Driven Russian Roulette and Splitting in Light
    Transport Simulation*, 2016: roulette (without splitting). Regions of surfaces, the estimates,
    and the measurement of the gain are ours.

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
