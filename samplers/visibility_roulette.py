"""Shadow rays that are rejected by learned visibility."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.shadow_rejection.parameters import RejectedShadowRays


@registry.plugin
class VisibilityRoulettePlugin(DecisionPlugin):
    r"""
    .. _sampler-visibility_roulette:

    Visibility roulette (:monosp:`visibility_roulette`)
    ---------------------------------------------------

    A decision for the slot :monosp:`shadow_test` of :monosp:`composed_path`. It learns from the
    first samples how often the lights are visible from each part of the scene, and rejects most of
    the shadow rays that would be blocked. The connections that are tested are weighted by the
    inverse of this probability, so the image is unbiased.

    .. pluginparameters::

     * - law
       - |string|
       - How the probability of tracing a shadow ray follows from the learned visibility V:
         :monosp:`affine` for min(1, slope · V + floor), :monosp:`paper` for max(V, 1e-4), as
         printed in the source, which traces fewer rays and is much noisier. (Default: affine)
     * - slope
       - |float|
       - Slope of the affine law; accepted only with that law. (Default: 10)
     * - floor
       - |float|
       - Lowest probability of the affine law, 1e-6 to 1; accepted only with that law. (Default:
         0.1)
     * - grid
       - |int|
       - Number of voxels along each axis of the scene's bounding box, 1 to 1024. This parameter and
         the next two are not accepted together with :monosp:`learned_lights`. (Default: 16)
     * - max_memory
       - |float|
       - Memory for what is learned, in MiB. If :monosp:`grid` needs more, a coarser grid is used,
         with a warning. (Default: 512)
     * - refine
       - |int|
       - Number of random visibility tests added to each pair of voxels (one of which contains a
         light) between which the pilots found an unoccluded ray; at most 1024. (Default: 16)

    **Use it when** most shadow rays are blocked, tracing them takes much of the time, and the
    choice of lights is not learned. **Not when** it is learned: hidden lights are then hardly ever
    chosen, and rejection increases the error by more than the time it saves.

    Together with :monosp:`learned_lights`, it uses the visibility of the light map, which includes
    lights at infinity. Otherwise it learns a map of pairs of voxels, and always tests connections
    to lights outside the scene's bounding box or at infinity. If fewer than 5 % of the shadow rays
    would be rejected, all are traced. Nested in :monosp:`moment`, the integrator takes no pilot
    samples, and all shadow rays are traced.

    Source: J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, sections 3 to 4.1
    (Eq. 2 is the law :monosp:`paper`).

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <string name="next_event" value="spatial"/>
                <sampler name="shadow_test" type="visibility_roulette">
                    <float name="floor" value="0.2"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': 'spatial',
            'shadow_test': {
                'type': 'visibility_roulette',
                'floor': 0.2
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr --integrator \
                "composed_path:next_event=spatial,shadow_test=[visibility_roulette:floor=0.2]"
    """

    kind = RejectedShadowRays
