"""Numbers of camera rays from weighted sets: points of the aperture, times, wavelengths."""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.camera_numbers import WeightedNumbers
from mitsuba_ext.composition.decision_plugin import DecisionPlugin


@registry.plugin
class WeightedNumbersPlugin(DecisionPlugin):
    r"""
    .. _sampler-weighted_numbers:

    Weighted numbers (:monosp:`weighted_numbers`)
    ---------------------------------------------

    A decision for the slots :monosp:`aperture`, :monosp:`time` and :monosp:`wavelength` of
    :monosp:`composed_path`. It takes the numbers that choose the point on the aperture, the time,
    or the wavelengths of a camera ray from well distributed sets, which can be weighted by the
    cells of the points. Each pixel has one set for all of its samples, chosen and moved at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see :monosp:`mitsuba_ext.pointsets.points`.
         (Default: lattice)
     * - weights
       - |string|
       - How the points are weighted: :monosp:`none` (all alike), :monosp:`torus` (by the sizes of
         periodic Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points that are
         folded, so that opposite ends need not be alike; not for wavelengths, as both ends of the
         spectrum are dark), or :monosp:`voronoi` (by cells that end at the border, as in the
         thesis: slightly biased). (Default: none)

    **Use it when** the sensor's sampler is :monosp:`independent`, and the noise is that of defocus
    (aperture), of motion (time) or of colours (wavelength). **Not when** the noise is that of light
    on things: these numbers change nothing about it. A :monosp:`multijitter` sampler distributes
    all numbers of a sample, as well or better.

    The sensor must have an aperture (:monosp:`thinlens`) or a shutter that stays open
    (:monosp:`shutter_open`, :monosp:`shutter_close`); otherwise a warning says that nothing is
    reweighted. Wavelengths need a spectral variant. There, a number u chooses four wavelengths, u +
    k/4. Where all four survive, light repeats itself after 1/4, and the cells are those of the
    numbers modulo 1/4. Where a path has been refracted by dispersive glass, one is left, and the
    cells are those of the whole circle.

    Sets have as many points as a pixel has samples, at most 1024 (64 with a :monosp:`timeout`);
    then there are several for each pixel. There are 32 sets (2 of :monosp:`poisson_disk`); with
    :monosp:`voronoi` weights they are not moved. The weights concern all channels, alpha and AOVs
    too. A :monosp:`box` filter of the film suits times best: a wider filter gives samples random
    weights, which keep part of the noise. Inside of :monosp:`moment`, nothing is reweighted.

    Around integrators of Mitsuba, use :monosp:`reweighted_lens`, :monosp:`reweighted_time` and
    :monosp:`reweighted_wavelength`.

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.1 (time), 4.5.2.2 (wavelengths)
    and 4.5.2.3 (aperture); periodic cells, that they are unbiased, and cells modulo 1/4 are ours.

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
