"""Directions of the environment by the product of BSDF and light."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.two_stage_lights.parameters import TwoStageLights


@registry.plugin
class TwoStageLightsPlugin(DecisionPlugin):
    r"""
    .. _sampler-two_stage_lights:

    Two-stage importance sampling (:monosp:`two_stage_lights`)
    ----------------------------------------------------------

    A decision for the slot :monosp:`next_event` of :monosp:`composed_path`. It samples directions
    of the environment (:monosp:`envmap`, :monosp:`sunsky`, :monosp:`constant`) in proportion to an
    estimate of the product of map and BSDF. Each vertex divides the map into rectangles, which are
    smaller where the BSDF varies more, and evaluates the BSDF at their corners. Sums of the map
    over rectangles come from a summed-area table. Within a rectangle, samples are warped by the
    texels of the map.

    .. pluginparameters::

     * - splits
       - |int|
       - Maximum number of times that a vertex divides rectangles, in addition to the first division
         into eight, 0 to 1024. The source makes as many divisions as a vertex has connections.
         (Default: 16)
     * - vertices
       - |string|
       - Which vertices of a path divide the map: the :monosp:`first`, or :monosp:`all`. At the
         other vertices, lights are chosen as in :monosp:`path`. (Default: first)
     * - visibility
       - |string|
       - How connections of first vertices take occlusion into account: not at all
         (:monosp:`unknown`), or by visibility maps that a pilot has learned, over random numbers
         (:monosp:`primary`) or over directions (:monosp:`world`). (Default: unknown)
     * - reallocated
       - |float|
       - With visibility maps: the share of the connections that the maps sample, 0 to 0.99. The
         other connections ignore visibility. (Default: 0.9)

    **Use it when** rough metal reflects an uneven map, most of which is visible from it, and each
    vertex has several :monosp:`connections`. These share the partition of the vertex, which takes
    longer to make than a path. **Not when** walls or other objects hide the bright parts of the
    map, unless :monosp:`visibility` is learned (the word :monosp:`triple_product` stands for this
    decision with maps in primary space); or for lobes nearly as narrow as a mirror's, for which
    BSDF samples are better.

    With :monosp:`visibility`, the integrator takes a pilot of :monosp:`pilot_spp` samples per pixel
    (by default 4, at most an eighth of all, in short renders a quarter; they count towards the
    image). For each tile of 8 pixels (larger ones if there would be more than 8192 tiles), it
    counts which shadow rays of first vertices are unoccluded: in 16 x 16 cells of the two random
    numbers that choose a direction, or in 32 x 16 cells of the map. The prior of a cell is the same
    cell of the surrounding tiles, whose prior is the mean over these tiles. In primary space, the
    random numbers of later samples are distributed in proportion to the square root of the
    visibility. With :monosp:`world`, the rectangles of the partition are weighted by the
    visibility, and divided where it varies; then use more :monosp:`splits`. Densities stay exact
    and positive, so the image is unbiased whatever the maps contain. Maps need no correction, and
    they are not made on demand: a map is an array of counters, and every connection still traces
    its shadow ray.

    Lights other than the environment are sampled as in :monosp:`path`, and so are all lights of a
    scene without an environment. BSDF samples are combined by MIS; lobes narrower than a texel are
    left to them. The density is positive wherever the map is defined: a hundredth of it follows the
    map alone. The table of the map takes 12 bytes for each of its texels. Not for :monosp:`bdpt`
    and other integrators with light paths.

    Source: D. Cline, P. K. Egbert, J. F. Talbot, D. L. Cardon, *Two Stage Importance Sampling for
    Direct Lighting*, EGSR 2006 (= D. Cline, PhD dissertation, BYU, 2007, chapter 5). The order of
    the divisions, and BSDF samples in place of the peaks of known models, are ours. Maps of
    visibility: chapter 6 of the dissertation; probabilities in place of classes, and densities that
    MIS can use, are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="next_event" type="two_stage_lights">
                    <integer name="splits" value="32"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': {
                'type': 'two_stage_lights',
                'splits': 32
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:next_event=[two_stage_lights:splits=32]"
    """

    kind = TwoStageLights
