"""Colours from weighted sets of wavelengths, around any integrator."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.composition.reweighted_camera import ReweightedCamera


@registry.plugin
class ReweightedWavelength(ReweightedCamera):
    r"""
    .. _integrator-reweighted_wavelength:

    Reweighted wavelengths (:monosp:`reweighted_wavelength`)
    --------------------------------------------------------

    Renders in spectral variants with the nested integrator, but takes the numbers that choose the
    wavelengths from :monosp:`weighted_numbers`: well distributed sets, which can be weighted by the
    cells of the numbers. Each pixel has one set for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - weights
       - |string|
       - How the points are weighted, see :monosp:`weighted_numbers`: :monosp:`none`,
         :monosp:`torus` or :monosp:`voronoi` (slightly biased). (Default: none)
     * - (Common parameters)
       - |several|
       - Those of :class:`ReweightedCamera`: pattern, timeout.
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours. To see dispersion
         (:monosp:`dispersive_dielectric`), it has to be one of ours.

    **Use it when** the noise is coloured: dispersive glass, lamps and filters with narrow spectra.
    **Not when** it is that of light on things, or of reflection and refraction in glass. In RGB
    variants there are no wavelengths: an error says so.

    The page of :monosp:`weighted_numbers` says more about sets and weights. Other dimensions of a
    sample are those of the sensor's sampler, or of a :monosp:`reweighted_lens` or
    :monosp:`reweighted_time` that is nested. An integrator of ours that is nested learns as it does
    alone; its own timeout is ignored. Inside of :monosp:`moment`, nothing is reweighted. Gradients
    are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.2; periodic cells, that they are
    unbiased, and cells modulo 1/4 are ours.

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
