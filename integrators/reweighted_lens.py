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
    :monosp:`weighted_numbers`: well distributed sets, which can be weighted by the cells of the
    points. Each pixel has one set for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - (Common parameters)
       - |several|
       - Those of :class:`ReweightedCamera`: pattern, weights, timeout, and the nested integrator.

    **Use it when** the noise is that of defocus: bright or detailed things far from the focal
    plane. **Not when** it is that of the light on them; samples of the lens change nothing about
    that. Without an aperture (a :monosp:`perspective` sensor), the nested integrator goes on alone,
    and a warning says so.

    The page of :monosp:`weighted_numbers` says more about sets and weights. Other dimensions of a
    sample are those of the sensor's sampler. An integrator of ours that is nested learns as it does
    alone; its own timeout is ignored. Inside of :monosp:`moment`, nothing is reweighted. Gradients
    are not supported (use :monosp:`prb`).

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
