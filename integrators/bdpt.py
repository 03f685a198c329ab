"""Bidirectional path tracing."""

from __future__ import annotations

from mitsuba_ext.bases.bidirectional_integrator import BidirectionalIntegrator
from mitsuba_ext.startup import registry


@registry.plugin
class BidirectionalPathTracing(BidirectionalIntegrator):
    r"""
    .. _integrator-bdpt:

    Bidirectional path tracer (:monosp:`bdpt`)
    ------------------------------------------

    For each sample, traces a path from the camera and a path from a light, connects their vertices,
    and weights all contributions by multiple importance sampling.

    .. pluginparameters::

     * - connections
       - |int|
       - How many vertices of light paths, chosen at random, each vertex of a camera path is
         connected to; 0 for none. (Default: 1)
     * - light_image
       - |bool|
       - Whether to connect light paths to the sensor as well (t = 1). This finds caustics that are
         seen directly. (Default: true)
     * - subpath_selection
       - |string|
       - How the vertices of light paths are chosen: :monosp:`uniform`, or by :monosp:`visibility`,
         which prefers regions whose vertices were visible from the camera path's vertex, and
         contributed light, in the pilot samples. (Default: uniform)
     * - light_paths
       - |float| or |string|
       - Number of light paths per camera path, from 0 (camera paths alone) to 64; or
         :monosp:`always`, which is 1; or :monosp:`auto`: pilot samples measure whether 0, 1/16,
         1/4, 1 or 4 light paths are most efficient in a render of this length, together with
         ``connections``, two or four times as many connections, or none. A short render may then
         miss light that only light paths find. (Default: always)
     * - sample_direct
       - |bool|
       - Whether to connect camera paths to points sampled on lights (s = 1). False shows what the
         other techniques find alone: surfaces lit by point lights or parallel light are then black
         if they are seen in a mirror or through glass. (Default: true)
     * - technique_images
       - |string|
       - Name of an OpenEXR file to which the image of each technique is written, with and without
         its MIS weights (layers :monosp:`weighted.s1_t2` and :monosp:`plain.s1_t2`, with s vertices
         on the light path and t on the camera path), for paths of up to 8 segments. (Default: none)
     * - next_event, directions, roulette, shadow_test
       - |string| or |decision|
       - Decisions of the camera paths, as in :class:`composed_path`. (Default: as in
         :monosp:`path`)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** light travels along paths that camera paths rarely find: caustics of lamps,
    lamps in fittings or near walls, indirect light from hidden lamps. **Not when** :monosp:`path`
    converges well: a sample costs about three times as much.

    Mitsuba offsets the origins of rays from the surface, by about 1e-4 · (1 + the largest
    coordinate). In scenes far from the origin, rays therefore miss nearby surfaces. Light paths
    miss other surfaces than camera paths do, so the image differs from the image of :monosp:`path`
    (by up to 3 % in a quarter of the image, in a scene moved by a thousand times its size). In
    scenes smaller than 0.1, rays of this package start closer to the surface, so that all its
    integrators give the same image as for the scene at size 1. Mitsuba's :monosp:`path` does not
    (2 % difference in a scene of a few thousandths).

    A technique has s vertices on the light path: 0 (a camera path hits the light), 1 (a connection
    to a point sampled on a light) or more. It has t vertices on the camera path: 1 (a vertex of a
    light path is connected to the sensor) or more. All these techniques are used, except light
    paths that hit the sensor (t = 0), because the sensor has little or no area. The MIS weights
    follow the power heuristic over all techniques, and account for the number of connections.

    All camera paths of a pass share the vertices of all its light paths. In spectral variants and
    with moving shapes, a camera path shares wavelengths and time with one light path, and is
    connected to that one only; ``light_paths`` must then be 0 or 1. If the number of light paths is
    not one, or the sampler is :monosp:`ldsampler`, whose numbers depend on each other, light paths
    draw independent random numbers.

    **Learned selection.** Surfaces are divided into regions, which are smaller in places with more
    vertices. Pilot samples (:monosp:`pilot_spp`, 16 by default, at most an eighth of all samples,
    in short renders a quarter; they count towards the image) measure the contributions of
    connections between each pair of regions, relative to the brightness of the pixel. A region is
    chosen in proportion to the root mean square of these contributions. A tenth of the choices
    remain uniform. The MIS weights account for how often each connection is made, so the image is
    unbiased. Use learned selection if most connections are blocked, as in corridors and between
    rooms. A sample takes about a fifth longer; if the first pilot shows a small gain, learning
    ends. In spectral variants and with moving shapes there is little to choose from, and the
    selection stays uniform.

    **Sensors and films.** Light paths can be connected to a :monosp:`perspective`,
    :monosp:`thinlens` or :monosp:`orthographic` sensor; with other sensors, and with films that
    sample a border, there is no light image. Lights of type :monosp:`directionalarea`, which
    :monosp:`path` does not find, are rendered, but spectral variants refuse them.

    **Participating media.** The image is the same as with :monosp:`volpath`. Light paths scatter in
    homogeneous and grid media, and connections pass through media, index-matched surfaces and
    masks. The MIS weights contain the transmittance of homogeneous media; grid media count as empty
    in the weights only. A light is taken to lie in the medium on its side of the closest boundary,
    in the direction of each light path; outside all boundaries, in the medium behind the last
    boundary that a ray from the sensor crosses. Lights at infinity are refused if that medium is
    not a vacuum, and so is :monosp:`subpath_selection=visibility`. The parameter
    ``sample_emitters`` of media is ignored: all their vertices are connected. Where light gets no
    deeper than the offset at which rays start (10⁻⁴ · (1 + the largest coordinate)), the image is
    brighter than with :monosp:`volpath`, and both are too dark.

    Gradients are not supported (use :monosp:`prb`); neither are scalar and polarized variants, nor
    nesting in :monosp:`moment` and :monosp:`aov`.

    Source: E. Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, PhD thesis, 1997,
    chapter 10; D. Cline, PhD thesis, 2007, sections 7.6 and 7.9; I. Georgiev, *Implementing Vertex
    Connection and Merging*, technical report, 2012 (weights); J. Guo, M. Eisemann, E. Eisemann,
    *Next Event Estimation++*, Computer Graphics Forum 39(7), 2020, section 4.3 (selection by
    visibility; the regions of surfaces, the contributions, and the counts in the weights are ours);
    E. Lafortune, Y. Willems, *Rendering Participating Media with Bidirectional Path Tracing*,
    Eurographics Workshop on Rendering, 1996.

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt',
            'max_depth': 8
    """
