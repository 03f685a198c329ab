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

    Renders depth of field with the nested integrator, but takes the points on the aperture from
    well distributed point sets. Each sample can be weighted by the Voronoi cell of its point. Each
    pixel uses one set for all of its samples, chosen and shifted at random.

    .. pluginparameters::

     * - pattern
       - |string|
       - How the points of a set are distributed: :monosp:`independent`, :monosp:`stratified`,
         :monosp:`latin_hypercube`, :monosp:`halton`, :monosp:`hammersley`, :monosp:`sobol`,
         :monosp:`lattice` or :monosp:`poisson_disk`; see
         :monosp:`mitsuba_ext.pointsets.points`. (Default: lattice)
     * - weights
       - |string|
       - Weights of the points: :monosp:`none` (all equal), :monosp:`torus` (areas of periodic
         Voronoi cells: unbiased), :monosp:`unbiased` (the same, with points mapped by 1 - |2u - 1|,
         which removes discontinuities at the border), or :monosp:`voronoi` (cells that end at the
         border, as in the thesis: slightly biased). (Default: none)
     * - timeout
       - |float|
       - Seconds after which to stop, 0 or less for no limit. With a limit, sets have at most 64
         points, and the render ends after a whole set. (Default: -1)
     * - (Nested plugin)
       - |integrator|
       - The integrator to render with, exactly one: any that samples camera rays, such as
         :monosp:`path`, :monosp:`volpath` or one of ours.

    **Use it when** the noise comes from defocus: bright or detailed objects far from the focal
    plane. **Not when** it comes from the lighting of these objects, which lens samples do not
    improve. For a sensor without an aperture (such as :monosp:`perspective`), the nested integrator
    renders as usual, with a warning.

    Sets have as many points as a pixel has samples, at most 1024 (with more samples, a pixel uses
    several sets). There are at most 32 sets (2 of :monosp:`poisson_disk`); with :monosp:`voronoi`
    weights they are not shifted. The weights apply to all channels, including alpha and AOVs. The
    sensor's sampler provides the other dimensions of a sample. A nested integrator of this package
    learns as usual; its own timeout is ignored. Inside of :monosp:`moment`, nothing is reweighted.
    Gradients are not supported (use :monosp:`prb`).

    Source: J. J. Guo, PhD thesis, TU Delft, sections 4.4 and 4.5.2.3. Periodic cells, and the fact
    that they are unbiased, are our addition.

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
