"""Lights that are chosen by learned visibility or contribution."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.learned_lights.parameters import LearnedLights


@registry.plugin
class LearnedLightsPlugin(DecisionPlugin):
    r"""
    .. _sampler-learned_lights:

    Learned lights (:monosp:`learned_lights`)
    -----------------------------------------

    A decision for the slot :monosp:`next_event` of :monosp:`composed_path`. It learns from the
    first samples which lights reach which surfaces, and samples lights accordingly, including parts
    of large lights and directions of the sky. It is unbiased. :monosp:`neepp` is a path tracer with
    this decision.

    .. pluginparameters::

     * - target
       - |string|
       - What determines the probability of a light, for each voxel and side of a surface: its
         :monosp:`contribution` (the light that arrived from it), or its :monosp:`visibility` (how
         often it was visible, times its unoccluded contribution). (Default: contribution)
     * - grid
       - |int|
       - Number of voxels along each axis of the region in which paths scatter, 1 to 1024. (Default:
         16, or fewer if the pilots have few samples for the number of visible voxels and lights)
     * - max_memory
       - |float|
       - Memory for what is learned, in MiB. If :monosp:`grid` needs more, a coarser grid is used,
         with a warning. (Default: 512)

    **Use it when** there are many lights, when most lights are hidden from most places (rooms, a
    sky seen through windows, lamps behind walls), or when large lights are partly covered. **Not
    when** one small light illuminates an open scene, or when most noise comes from indirect or
    glossy light: learning then costs time and gains nothing.

    A first sample per pixel, which is not added to the film, finds the surfaces and the region in
    which paths scatter. In scenes with several lights, the first pilot chooses them by a light tree
    (:monosp:`next_event=tree`). If a table is predicted to be less than 1.2 times as efficient, the
    tree stays, and learning ends. Otherwise each further pilot chooses its lights by what the
    earlier pilots have learned. All samples have the same weight, and no stage uses what it learns
    from its own samples, so the image is unbiased. A tenth of the choices do not depend on what was
    learned. The second and third pilots measure how much lower the variance of the image is than
    with the choice of :monosp:`path`. If the reduction is less than about 15 %, the table is not
    worth the time of its look-ups, and learning ends, unless :monosp:`grid` or also a
    :monosp:`visibility_roulette` is given. The integrator saves the map with everything else that
    it has learned (:monosp:`save_learned`).

    Lights on meshes with interpolated normals are sampled by the area of their triangles;
    :monosp:`path` is biased for these lights, because of a fault in Mitsuba. Nested in
    :monosp:`moment`, and in renders of fewer than four samples per pixel, the integrator takes no
    pilot samples, and lights are chosen by a light tree.

    Source: J. Guo, M. Eisemann, E. Eisemann, *Next Event Estimation++: Visibility Mapping for
    Efficient Light Transport Simulation*, Computer Graphics Forum 39(7), 2020, section 4.2
    (choosing by visibility). The sides of surfaces, the parts of lights, the contributions, and the
    measurement of the gain are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="next_event" type="learned_lights">
                    <integer name="grid" value="24"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'next_event': {
                'type': 'learned_lights',
                'grid': 24
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:next_event=[learned_lights:grid=24]"
    """

    kind = LearnedLights
