"""Colours from weighted sets of wavelengths, around any integrator."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.startup import registry

from ._reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedWavelength(ReweightedCamera):
    r"""
    .. _integrator-reweighted_wavelength:

    Reweighted wavelengths (:monosp:`reweighted_wavelength`)
    --------------------------------------------------------

    Renders in spectral variants with the nested integrator, but takes the random numbers that
    choose the wavelengths from the well distributed point sets of :monosp:`weighted_numbers`, where
    each sample can be weighted by the Voronoi cell of its number. Each pixel uses one set for all
    of its samples.

    .. pluginparameters::

     * - weights
       - |string|
       - Weights of the points, see :monosp:`weighted_numbers`: :monosp:`none`, :monosp:`torus` or
         :monosp:`voronoi` (slightly biased). (Default: none)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`ReweightedCamera`: pattern, timeout, checkpoint.
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of this package. Only integrators of this package
         render dispersion (:monosp:`dispersive_dielectric`).

    **Use it when** the noise is coloured: dispersive glass, lamps and filters with narrow spectra.
    **Not when** it comes from lighting, or from the choice between reflection and refraction in
    glass. RGB and monochrome variants have no wavelengths, and raise an error.

    The page of :monosp:`weighted_numbers` describes the sets and weights in detail. The other
    dimensions of a sample come from the sensor's sampler, or from a nested
    :monosp:`reweighted_lens` or :monosp:`reweighted_time`. A nested integrator of this package
    learns as usual; its own timeout is ignored. If it is nested in :monosp:`moment`, nothing is
    reweighted. Gradients are not supported (use :class:`composed_prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.2. Periodic cells, which are
    unbiased, and cells modulo 1/4 are our additions.

    .. tabs::
        .. code-tab:: xml

            <integrator type="reweighted_wavelength">
                <integrator type="composed_path">
                    <integer name="max_depth" value="8"/>
                </integrator>
            </integrator>

        .. code-tab:: python

            'type': 'reweighted_wavelength',
            'nested': {
                'type': 'composed_path',
                'max_depth': 8
            }
    """

    purpose = "wavelength"

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.numbers.check_slot(self.name, self.purpose)
