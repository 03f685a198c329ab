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
    wavelengths from well distributed point sets. Each sample can be weighted by the Voronoi cell of
    its number. Each pixel uses one set for all of its samples, chosen and shifted at random.

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
         Voronoi cells: unbiased; there is no discontinuity, because both ends of the spectrum are
         dark), or :monosp:`voronoi` (cells that end at the border, as in the thesis: slightly
         biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. With a limit, sets have at most 64
         points, and the render ends after a whole set. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours. Only integrators of this package render
         dispersion (:monosp:`dispersive_dielectric`).

    **Use it when** the noise is coloured: dispersive glass, lamps and filters with narrow spectra.
    **Not when** it comes from lighting, or from the choice between reflection and refraction in
    glass. RGB and monochrome variants have no wavelengths, and raise an error.

    A number u chooses four wavelengths by the numbers u + k/4 (modulo 1). If a path keeps all four,
    its contribution is a function of u with period 1/4, and its weight is the cell of u modulo 1/4.
    If dispersive glass has refracted the path, only the hero wavelength is left, the period is 1,
    and its weight is the cell of u itself. Both weights occur in one image.

    Sets have as many numbers as a pixel has samples, at most 1024 (with more samples, a pixel uses
    several sets). There are at most 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi`
    weights they are not shifted. The weights apply to all channels, including alpha and AOVs. The
    other dimensions of a sample come from the sensor's sampler, or from a nested
    :monosp:`reweighted_lens` or :monosp:`reweighted_time`. A nested integrator of this package
    learns as usual; its own timeout is ignored. Inside of :monosp:`moment`, nothing is reweighted.
    Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.2. Periodic cells, the fact that
    they are unbiased, and cells modulo 1/4 are our addition.

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
