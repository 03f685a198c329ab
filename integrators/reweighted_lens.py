"""Depth of field from weighted sets of lens points, around any integrator."""

from __future__ import annotations

from mitsuba_ext.startup import registry

from ._reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedLens(ReweightedCamera):
    r"""
    .. _integrator-reweighted_lens:

    Reweighted lens samples (:monosp:`reweighted_lens`)
    ---------------------------------------------------

    Renders depth of field with the nested integrator, but takes the points on the aperture from the
    well distributed point sets of :monosp:`weighted_numbers`, where each sample can be weighted by
    the Voronoi cell of its point. Each pixel uses one set for all of its samples.

    .. pluginparameters::

     * - (Common parameters)
       - |several|
       - The parameters of :class:`ReweightedCamera`: pattern, weights, timeout, checkpoint, and the
         nested integrator.

    **Use it when** the noise comes from defocus: bright or detailed objects far from the focal
    plane. **Not when** it comes from the lighting of these objects, which lens samples do not
    improve. For a sensor without an aperture (such as :monosp:`perspective`), the nested integrator
    renders as usual, with a warning.

    The page of :monosp:`weighted_numbers` describes the sets and weights in detail. The other
    dimensions of a sample come from the sensor's sampler. A nested integrator of this package
    learns as usual; its own timeout is ignored. If it is nested in :monosp:`moment`, nothing is
    reweighted. Gradients are not supported (use :class:`composed_prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.3. Periodic cells, which are
    unbiased, are our addition.

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
