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

    Renders motion blur with the nested integrator, but takes the times in the shutter interval from
    well distributed point sets. Each sample can be weighted by the Voronoi cell of its time. Each
    pixel uses one set for all of its samples, chosen and shifted at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - Weights of the points: :monosp:`none` (all equal), :monosp:`torus` (lengths of periodic
         Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points mapped by 1 - |2u - 1|,
         which removes the discontinuity between both ends), or :monosp:`voronoi` (cells that end at
         the border, as in the thesis: slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. With a limit, sets have at most 64
         points, and the render ends after a whole set. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`composed_path`. Only integrators of this package render :monosp:`moving` shapes.

    **Use it when** the sensor's sampler is :monosp:`independent` and the noise comes from motion:
    fast shapes (:monosp:`moving`), long streaks, hard edges. **Not when** it comes from the
    lighting of the shapes, which other times do not improve. A :monosp:`multijitter` sampler
    distributes times, and all other dimensions, equally well. For a sensor whose shutter interval
    is empty (:monosp:`shutter_open`, :monosp:`shutter_close`), the nested integrator renders as
    usual, with a warning.

    Use a :monosp:`box` filter for the film. A wider filter gives samples random weights, whose
    noise remains however well the times are distributed.

    Sets have as many times as a pixel has samples, at most 1024 (with more samples, a pixel uses
    several sets). There are at most 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi`
    weights they are not shifted. The weights apply to all channels, including alpha and AOVs. The
    other dimensions of a sample come from the sensor's sampler, or from a nested
    :monosp:`reweighted_lens` or :monosp:`reweighted_wavelength`. A nested integrator of this
    package learns as usual; its own timeout is ignored. Inside of :monosp:`moment`, nothing is
    reweighted. Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.1. Periodic cells, and the fact
    that they are unbiased, are our addition.

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
