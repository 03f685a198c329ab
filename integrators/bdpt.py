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

    Traces a path from the camera and a path from a light for each sample, connects their vertices,
    and weights all contributions by multiple importance sampling.

    .. pluginparameters::

     * - connections
       - |int|
       - To how many vertices of light paths, chosen at random, each vertex of a camera path is
         connected; 0 for none. (Default: 1)
     * - light_image
       - |bool|
       - Connect light paths to the sensor as well (t = 1)? This finds caustics that are seen
         directly. (Default: true)
     * - subpath_selection
       - |string|
       - How these vertices of light paths are chosen: :monosp:`uniform`, or by :monosp:`visibility`
         (preferably in regions whose vertices were visible from the camera path's vertex, and
         brought light, in the pilot samples). (Default: uniform)
     * - light_paths
       - |float| or |string|
       - Number of light paths for each camera path, from 0 (camera paths alone) to 64; or
         :monosp:`always`, which is 1; or :monosp:`auto`: pilot samples measure whether 0, 1/16,
         1/4, 1 or 4 are most efficient in a render of this length, with ``connections``, two or
         four times as many, or without any. Light that only light paths find may be missing in a
         short render.
         (Default: always)
     * - sample_direct
       - |bool|
       - Connect camera paths to points that are sampled on lights (s = 1)? False shows what the
         other techniques find alone: surfaces lit by point lights or parallel light are then black
         where they are seen in a mirror or through glass. (Default: true)
     * - technique_images
       - |string|
       - An OpenEXR file to which the image of each technique is written, with and without its MIS
         weights (layers :monosp:`weighted.s1_t2`, :monosp:`plain.s1_t2`; s vertices on the light
         path, t on the camera path), for paths of up to 8 segments. (Default: none)
     * - next_event, directions, roulette, shadow_test
       - |string| or |decision|
       - Decisions of the camera paths, as in :class:`composed_path`. (Default: those of
         :monosp:`path`)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`WalkIntegrator`: max_depth, rr_depth, hide_emitters, timeout,
         aovs, checkpoint.

    **Use it when** light travels along paths that camera paths rarely find: caustics of lamps,
    lamps in fittings or near walls, indirect light from hidden lamps. **Not when** :monosp:`path`
    converges well: a sample costs about three times as much.

    Mitsuba offsets the origins of rays from the surface, by about 1e-4 · (1 + the largest
    coordinate). In scenes far from the origin, rays therefore miss nearby surfaces; light paths
    miss other ones than camera paths, so that the image differs from that of :monosp:`path` (by up
    to 3 % in a quarter of the image, in a scene moved by a thousand times its size). In scenes
    smaller than 0.1, rays of this package start closer to the surface: all its integrators give the
    image of the same scene at size 1. Mitsuba's :monosp:`path` does not (2 % difference in a scene
    of a few thousandths).

    A technique has s vertices on the light path: 0 (a camera path hits the light), 1 (a connection
    to a point that is sampled on a light) or more. It has t vertices on the camera path: 1 (a
    vertex of a light path is connected to the sensor) or more. All these techniques are used. Light
    paths that hit the sensor (t = 0) do not count, because the sensor has no area, or hardly any.
    The MIS weights are the power heuristic over all techniques, and take the number of connections
    into account.

    In a pass, the vertices of all light paths are shared by all camera paths. In spectral variants
    and with moving shapes, a camera path shares wavelengths and time with one light path, and is
    connected to that one only: there, ``light_paths`` is 0 or 1. With another number of light paths
    than one, and with the sampler :monosp:`ldsampler`, whose numbers depend on each other, light
    paths draw independent random numbers.

    **Learned selection.** Surfaces are divided into regions, which are smaller where there are more
    vertices. Pilot samples (:monosp:`pilot_spp`, 16 by default, at most a quarter of all samples;
    they count towards the image) measure the contributions of connections between each pair of
    regions, relative to the brightness of the pixel. A region is chosen in proportion to the root
    mean square of these contributions. A tenth of the choices stays uniform. The MIS weights take
    into account how often each connection is made, so that the image is unbiased. Use it where most
    connections are blocked: in corridors, and between rooms. A sample takes about a fifth longer;
    where the first pilot shows that little is gained, learning ends. In spectral variants and with
    moving shapes there is little to choose from, and the selection stays uniform.

    **Sensors and films.** Light paths can be connected to a :monosp:`perspective` or
    :monosp:`thinlens`; with other sensors, and with films that sample a border, there is no light
    image. Lights of the type :monosp:`directionalarea`, which :monosp:`path` does not find, are
    rendered; spectral variants refuse them.

    Participating media are refused: the light paths do not scatter in them (use :monosp:`sppm`,
    :monosp:`composed_path` or :monosp:`volpath`). Gradients are not supported (use :monosp:`prb`);
    neither are scalar and polarized variants, nor nesting in :monosp:`moment` and :monosp:`aov`.

    Source: E. Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, PhD thesis, 1997,
    chapter 10; D. Cline, PhD thesis, 2007, sections 7.6 and 7.9; I. Georgiev, *Implementing Vertex
    Connection and Merging*, technical report, 2012 (weights); J. Guo, M. Eisemann, E. Eisemann,
    *Next Event Estimation++*, Computer Graphics Forum 39(7), 2020, section 4.3 (selection by
    visibility; regions of surfaces, contributions, and counts in the weights are ours).

    .. tabs::
        .. code-tab:: xml

            <integrator type="bdpt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'bdpt',
            'max_depth': 8
    """
