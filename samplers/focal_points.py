"""Directions to the places through which light passes."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.focal_points.parameters import FocalPoints


@registry.plugin
class FocalPointsPlugin(DecisionPlugin):
    r"""
    .. _sampler-focal_points:

    Focal points (:monosp:`focal_points`)
    -------------------------------------

    A decision for the slot :monosp:`scattering` of :monosp:`composed_path`. It learns from the
    first samples where in space light passes: keyholes, slits, gaps of doors, windows, bright
    spots, and the real and virtual images behind lenses and mirrors. A share of the directions of a
    path then lead there, and the BSDF samples the others. It is unbiased, and needs no knowledge of
    portals.

    .. pluginparameters::

     * - boxes
       - |int|
       - The most boxes that stand for these places, up to 256. Each takes up to 3 % of the time
         of a sample. (Default: 32)
     * - always_use
       - |bool|
       - Whether directions lead to focal points even if the pilots show that this does not pay.
         (Default: false)

    **Use it when** nearly all light comes through a small opening, however the camera sees it.
    **Not when** most light is direct (choose lights better, with :monosp:`learned_lights`), when
    light comes from all over, or when an image has fewer than 16 samples per pixel.

    Each direction in which a path has found light is a line, which goes on behind surfaces: a focal
    point is where many lines cross. Expectation maximization finds the boxes that explain the lines
    best. It begins with 8 cubes along the longest edge of the region that paths reach, divides
    cubes in which lines cross into eight, three times, and leaves others out. A box is then
    enlarged by half, because pilots have few lines. Each region of surfaces has its own
    probabilities of the boxes, and of BSDF samples (at least 20 %). The density of a direction is
    the sum over the boxes that it crosses, and MIS weights are computed from the density of the
    mixture.

    Boxes that are fitted to half of the paths of the first pilot show, on the other half, whether
    learning is hopeless. If it is not, the second pilot draws directions to what the first one has
    found, and measures what that gains. If it does not pay, directions are sampled as in
    :monosp:`path`. If it removes more than 60 % of the variance, the samples of the first two
    pilots do not count towards the image, because they would be its largest noise. With fewer than
    3 pilot samples per pixel (:monosp:`pilot_spp` of the integrator), nothing is learned. After a
    render, :monosp:`integrator.statistics.learned` describes what was learned, and
    :monosp:`integrator.learners["scattering"].decision.density` has the boxes.

    Beside guided directions (:monosp:`directions=guided`), either one or the other is used: focal
    points, if the first pilot predicts less than 0.4 of the variance, half its standard error
    included, or if the second one predicts a higher efficiency than it measures for guided
    directions. With :monosp:`always_use` here, or :monosp:`always_guide` there, both are used
    together, which is unbiased, and gains little. :class:`auto` and :class:`auto_path` choose in
    this way.

    In participating media, paths scatter as in :monosp:`volpath`. Nested in :monosp:`moment`, the
    integrator takes no pilot samples, and nothing is learned.

    Source: A. Rath, P. Grittmann, S. Herholz, P. Weier, P. Slusallek, *Focal Path Guiding for Light
    Transport Simulation*, SIGGRAPH 2023. There, an octree holds the density, which is the same from
    everywhere. The regions, the number of boxes, and the measurement of the gain are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="scattering" type="focal_points">
                    <integer name="boxes" value="64"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'scattering': {
                'type': 'focal_points',
                'boxes': 64
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr \
                --integrator "composed_path:scattering=[focal_points:boxes=64]"
    """

    kind = FocalPoints
