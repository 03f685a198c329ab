"""Lights that are chosen by their unoccluded contributions to a voxel."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.spatial_lights.parameters import SpatialLights


@registry.plugin
class SpatialLightsPlugin(DecisionPlugin):
    r"""
    .. _sampler-spatial_lights:

    Spatial light distribution (:monosp:`spatial_lights`)
    -----------------------------------------------------

    A decision for the slot :monosp:`next_event` of :monosp:`composed_path`. It chooses a light in
    proportion to its unoccluded contribution to the voxel of the vertex. These contributions are
    computed before the first sample, and nothing is learned.

    .. pluginparameters::

     * - grid
       - |int|
       - Number of voxels along each axis of the scene's bounding box, 1 to 1024. (Default: 32, or
         what fits into the memory)
     * - max_memory
       - |float|
       - Memory for the table of probabilities, in MiB. If :monosp:`grid` needs more, a coarser grid
         is used, with a warning. (Default: 512)

    **Use it when** there are many lights, and most places see the lights near them. **Not when**
    walls hide most lights: :monosp:`learned_lights` takes walls into account, and also divides
    large lights and the sky. With a single light, it has no effect.

    Points outside all voxels with geometry share one row of the table. No light has less than a
    thousandth of the mean of its row, so a wrong estimate cannot exclude it.

    Source: the light distribution :monosp:`spatial` of pbrt-v3 (src/core/lightdistrib.cpp).

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="next_event" type="spatial_lights">
                    <integer name="grid" value="48"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': {
                'type': 'spatial_lights',
                'grid': 48
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:next_event=[spatial_lights:grid=48]"
    """

    kind = SpatialLights
