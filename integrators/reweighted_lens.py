"""Depth of field from weighted sets of lens points, around any integrator."""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedLens(ReweightedCamera):
    r"""
    .. _integrator-reweighted_lens:

    Reweighted lens samples (:monosp:`reweighted_lens`)
    ---------------------------------------------------

    Renders depth of field with the nested integrator, but takes the points of the aperture from
    well distributed sets, which can be weighed by the cells of the points. Each pixel has one set
    for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - How they are weighed: :monosp:`none` (all alike), :monosp:`torus` (by the areas of periodic
         Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points that are folded,
         so that opposite edges need not be alike), or :monosp:`voronoi` (by cells that end at the
         border, as in the thesis: slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. Sets, which then have at most 64
         points, are kept whole. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours.

    **Use it when** the noise is that of defocus: bright or detailed things far from the focal
    plane. **Not when** it is that of the light on them; samples of the lens change nothing about
    that. Without an aperture (a :monosp:`perspective` sensor), the nested integrator goes on
    alone, and a warning says so.

    Sets have as many points as a pixel has samples, at most 1024 (then there are several for
    each pixel). There are 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi` weights
    they are not moved. The weights concern all channels, alpha and AOVs too. Other dimensions
    of a sample are those of the sensor's sampler. An integrator of ours that is nested learns
    as it does alone; its own timeout is ignored. Inside of :monosp:`moment`, nothing is
    reweighted. Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.3; periodic cells, and that they
    are unbiased, are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="reweighted_lens">
                <string name="pattern" value="sobol"/>
                <integrator type="path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'reweighted_lens',
            'pattern': 'sobol',
            'nested': {
                'type': 'path',
                'max_depth': 8
            }
    """

    purpose = "aperture"
