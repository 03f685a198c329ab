"""Numbers of camera rays from weighted sets: points of the aperture, times, wavelengths."""

from __future__ import annotations

from mitsuba_ext.bases.decision_plugin import DecisionPlugin
from mitsuba_ext.startup import registry
from mitsuba_ext.techniques.weighted_points.camera_numbers import WeightedNumbers


@registry.plugin
class WeightedNumbersPlugin(DecisionPlugin):
    r"""
    .. _sampler-weighted_numbers:

    Weighted numbers (:monosp:`weighted_numbers`)
    ---------------------------------------------

    A decision for the slots :monosp:`aperture`, :monosp:`time` and :monosp:`wavelength` of
    :monosp:`composed_path`. It takes the random numbers that choose the point on the aperture, the
    time, or the wavelengths of a camera ray from well distributed point sets. Each sample can be
    weighted by the Voronoi cell of its point. Each pixel uses one set for all of its samples,
    chosen and shifted at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.util.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - Weights of the points: :monosp:`none` (all equal), :monosp:`torus` (areas or lengths of
         periodic Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points mapped by
         ``1 - |2u - 1|``, which removes discontinuities at the border; not for wavelengths, which
         have no discontinuity there, because both ends of the spectrum are dark), or
         :monosp:`voronoi` (cells that end at the border, as in the thesis: slightly biased).
         (Default: none)

    **Use it when** the sensor's sampler is :monosp:`independent`, and the noise comes from defocus
    (aperture) or motion (time), or is coloured (wavelength). **Not when** the noise comes from
    lighting, which these numbers do not improve. A :monosp:`multijitter` sampler distributes these
    and all other dimensions equally well or better.

    The sensor must have an aperture (:monosp:`thinlens`) or a shutter that stays open
    (:monosp:`shutter_open`, :monosp:`shutter_close`); otherwise nothing is reweighted, with a
    warning. Wavelengths need a spectral variant. A number u chooses four wavelengths, through the
    numbers u + k/4 (modulo 1). If a path keeps all four, its contribution is a function of u with
    period 1/4, and its weight is the cell of u modulo 1/4. If dispersive glass has refracted the
    path, only the hero wavelength remains, the period is 1, and its weight is the cell of u itself.
    Both weights occur in one image.

    Sets have as many points as a pixel has samples, at most 1024, or 64 with a :monosp:`timeout`
    (with more samples, a pixel uses several sets). There are at most 32 sets (2 of
    :monosp:`poisson_disk`); with :monosp:`voronoi` weights they are not shifted. The weights apply
    to all channels, including alpha and AOVs. Use a :monosp:`box` filter for the film: a wider
    filter gives samples random weights, whose noise remains however well the points are
    distributed. If the integrator is nested in :monosp:`moment`, nothing is reweighted.

    Around integrators of Mitsuba, use :monosp:`reweighted_lens`, :monosp:`reweighted_time` and
    :monosp:`reweighted_wavelength`.

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.1 (time), 4.5.2.2 (wavelengths)
    and 4.5.2.3 (aperture). Periodic cells, which are unbiased, and cells modulo 1/4 are our
    additions.

    .. tabs::
        .. code-tab:: xml

            <integrator type="composed_path">
                <sampler name="aperture" type="weighted_numbers">
                    <string name="pattern" value="sobol"/>
                    <string name="weights" value="unbiased"/>
                </sampler>
            </integrator>

        .. code-tab:: python

            'type': 'composed_path',
            'aperture': {
                'type': 'weighted_numbers',
                'pattern': 'sobol',
                'weights': 'unbiased'
            }

        .. code-tab:: bash

            mitsuba-ext render scene.xml -o image.exr --integrator \
                "composed_path:aperture=[weighted_numbers:pattern=sobol,weights=unbiased]"
    """

    kind = WeightedNumbers
