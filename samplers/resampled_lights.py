"""Lights that are chosen among candidates by their unoccluded contributions."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.resampled_lights.parameters import ResampledLightsChoice


@registry.plugin
class ResampledLightsPlugin(DecisionPlugin):
    r"""
    .. _sampler-resampled_lights:

    Resampled lights (:monosp:`resampled_lights`)
    ---------------------------------------------

    A decision for the slot :monosp:`next_event` of :monosp:`composed_path`: resampled importance
    sampling. Each connection draws several candidates. These are light samples, as in
    :monosp:`path`; if there is an environment, half of the candidates are BSDF samples, which are
    looked up in it. The connection evaluates BSDF and light for all candidates, chooses one in
    proportion to its unoccluded contribution, and traces one shadow ray.

    .. pluginparameters::

     * - candidates
       - |int|
       - Number of candidates of a connection, 1 to 1024. (Default: 8)

    **Use it when** there are many lights, or large or dissimilar ones, or glossy objects reflect an
    environment, and most of the light is visible. **Not when** walls hide most of the light: the
    choice ignores occlusion (:monosp:`learned_lights` takes it into account).

    MIS with BSDF samples uses the density of all candidates together, times their number. The image
    is unbiased. Not for :monosp:`bdpt` and other integrators with light paths: these do not provide
    the density with which the BSDF would have sampled the light.

    Source: J. Talbot, D. Cline, P. Egbert, *Importance Resampling for Global Illumination*, EGSR
    2005; D. Cline, PhD dissertation, BYU, 2007, section 4.4.4. The use of the density of the
    candidates in MIS, and lattices as candidates, are our additions.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="next_event" type="resampled_lights">
                    <integer name="candidates" value="32"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': {
                'type': 'resampled_lights',
                'candidates': 32
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:next_event=[resampled_lights:candidates=32]"
    """

    kind = ResampledLightsChoice
