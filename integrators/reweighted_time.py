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
    :monosp:`weighted_numbers`: well distributed sets, which can be weighted by the cells of the
    times. Each pixel has one set for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - (Common parameters)
       - |several|
       - Those of :class:`ReweightedCamera`: pattern, weights, timeout.
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

    The page of :monosp:`weighted_numbers` says more about sets and weights. Other dimensions of a
    sample are those of the sensor's sampler, or of a :monosp:`reweighted_lens` or
    :monosp:`reweighted_wavelength` that is nested. An integrator of ours that is nested learns as
    it does alone; its own timeout is ignored. Inside of :monosp:`moment`, nothing is reweighted.
    Gradients are not supported (use :monosp:`prb`).

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
