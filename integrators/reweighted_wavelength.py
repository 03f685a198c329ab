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
    wavelengths from well distributed sets, which can be weighed by the cells of the numbers. Each
    pixel has one set for all of its samples, chosen and moved at random.

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
         periodic Voronoi cells: unbiased; both ends of the spectrum are dark, so that there is no
         seam), or :monosp:`voronoi` (by cells that end at the border, as in the thesis: slightly
         biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. Sets, which then have at most 64
         points, are kept whole. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours. To see dispersion
         (:monosp:`dispersive_dielectric`), it has to be one of ours.

    **Use it when** the noise is coloured: dispersive glass, lamps and filters with narrow spectra.
    **Not when** it is that of light on things, or of reflection and refraction in glass. In RGB
    variants there are no wavelengths: an error says so.

    A number u chooses four wavelengths, u + k/4. Where all four survive, light repeats itself after
    1/4, and the cells are those of the numbers modulo 1/4; where a path has been refracted by
    dispersive glass, one is left, and the cells are those of the whole circle. Both are used in one
    image.

    Sets have as many numbers as a pixel has samples, at most 1024 (then there are several for each
    pixel). There are 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi` weights they are
    not moved. The weights concern all channels, alpha and AOVs too. Other dimensions of a sample
    are those of the sensor's sampler, or of a :monosp:`reweighted_lens` or
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
