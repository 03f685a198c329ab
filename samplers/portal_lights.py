"""Directions of the environment through portals."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.portal_lights.parameters import PortalLights


@registry.plugin
class PortalLightsPlugin(DecisionPlugin):
    r"""
    .. _sampler-portal_lights:

    Portal-masked environment sampling (:monosp:`portal_lights`)
    ------------------------------------------------------------

    A decision for the slot :monosp:`next_event` of :monosp:`composed_path`. From each vertex, it
    samples the part of the environment visible through openings, in proportion to its radiance.
    Shapes of type :monosp:`portal` mark these openings.

    .. pluginparameters::

     * - share
       - |float|
       - The share of the connections to the environment that are sampled through portals, 0 to
         0.99. The other connections are sampled as in :monosp:`path`, and find light that no portal
         shows. (Default: 0.9)

    **Use it when** a sky (:monosp:`envmap`, :monosp:`sunsky`, :monosp:`constant`) lights a room
    through windows. **Not when** the sun shines in: most noise then comes from the light reflected
    by the sunlit patch, which portals do not reduce, and a sample takes two to four times as long;
    or when most of the picture is outdoors. Not for :monosp:`bdpt` and other integrators with light
    paths.

    For each orientation of portals, the environment is stored, with a summed-area table in double
    precision, in coordinates in which the part visible through a portal from any point is an
    axis-aligned rectangle. Each axis covers 180° with as many texels as the map has columns, 256 to
    2048 (12 bytes for each texel). A portal is chosen by the sum over its rectangle. Only the edges
    of the portal are known, not objects in the opening or in front of it. Samples through the part
    of a portal below the surface at a vertex are wasted.

    The density is exact and known in every direction, so it can be combined with BSDF samples by
    MIS. At points that see no portal from inside, for lights other than the environment, and in
    scenes without portals or environment, lights are sampled as in :monosp:`path`.

    Source: B. Bitterli, J. Novák, W. Jarosz, *Portal-Masked Environment Map Sampling*, Computer
    Graphics Forum 34(4), 2015. The share of ordinary samples is ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="next_event" type="portal_lights">
                    <float name="share" value="0.8"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': {
                'type': 'portal_lights',
                'share': 0.8
            }

        .. code-tab:: bash

            mitsuba-ext render scenes/portal_room.xml -o image.exr \
                --integrator "composed_path:next_event=[portal_lights:share=0.8]"
    """

    kind = PortalLights
