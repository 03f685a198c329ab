"""Motion blur from weighted sets of times, around any integrator."""

from __future__ import annotations

from mitsuba_ext.startup import registry

from ._reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedTime(ReweightedCamera):
    r"""
    .. _integrator-reweighted_time:

    Reweighted times (:monosp:`reweighted_time`)
    --------------------------------------------

    Renders motion blur with the nested integrator, but takes the times in the shutter interval from
    the well distributed point sets of :monosp:`weighted_numbers`, where each sample can be weighted
    by the Voronoi cell of its time. Each pixel uses one set for all of its samples.

    .. pluginparameters::

     * - (Common parameters)
       - |several|
       - The parameters of :class:`ReweightedCamera`: pattern, weights, timeout, checkpoint.
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

    The page of :monosp:`weighted_numbers` describes the sets and weights in detail. The other
    dimensions of a sample come from the sensor's sampler, or from a nested
    :monosp:`reweighted_lens` or :monosp:`reweighted_wavelength`. A nested integrator of this
    package learns as usual; its own timeout is ignored. If it is nested in :monosp:`moment`,
    nothing is reweighted. Gradients are not supported (use :class:`composed_prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.1. Periodic cells, which are
    unbiased, are our addition.

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
