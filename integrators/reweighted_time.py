"""Motion blur from weighted sets of times, around any integrator."""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedTime(ReweightedCamera):
    r"""
    .. _integrator-reweighted_time:

    Reweighted times (:monosp:`reweighted_time`)
    --------------------------------------------

    Renders motion blur with the nested integrator, but takes the times of the shutter interval from
    well distributed sets, which can be weighed by the cells of the times. Each pixel has one
    set for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - How they are weighed: :monosp:`none` (all alike), :monosp:`torus` (by the lengths of
         periodic Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points that are
         folded, so that the ends need not be alike), or :monosp:`voronoi` (by cells that end at the
         border, as in the thesis: slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. Sets, which then have at most 64
         points, are kept whole. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`composed_path`. To see :monosp:`moving` shapes, it has to be one of ours.

    **Use it when** the sensor's sampler is :monosp:`independent` and the noise is that of motion:
    fast shapes (:monosp:`moving`), long streaks, hard edges. **Not when** it is that of the light
    on them; other times change nothing about that. A :monosp:`multijitter` sampler distributes
    times, and all else, as well. With a sensor whose shutter does not stay open
    (:monosp:`shutter_open`, :monosp:`shutter_close`), the nested integrator goes on alone, and a
    warning says so.

    A :monosp:`box` filter of the film suits it best. A wider filter gives samples random weights,
    and these keep part of the noise, however well times are distributed.

    Sets have as many times as a pixel has samples, at most 1024 (then there are several for
    each pixel). There are 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi` weights
    they are not moved. The weights concern all channels, alpha and AOVs too. Other dimensions
    of a sample are those of the sensor's sampler, or of a :monosp:`reweighted_lens` or
    :monosp:`reweighted_wavelength` that is nested. An integrator of ours that is nested learns
    as it does alone; its own timeout is ignored. Inside of :monosp:`moment`, nothing is
    reweighted. Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.1; periodic cells, and that they
    are unbiased, are ours.

    .. tabs::
        .. code-tab:: xml

            <integrator type="reweighted_time">
                <integrator type="composed_path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'reweighted_time',
            'nested': {
                'type': 'composed_path',
                'max_depth': 8
            }
    """

    purpose = "time"
