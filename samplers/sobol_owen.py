"""Sobol' sequence with Owen scrambling."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.sobol import Sobol


@registry.plugin
class SobolSampler(SequenceSampler):
    r"""
    .. _sampler-sobol_owen:

    Sobol' sequence with Owen scrambling (:monosp:`sobol_owen`)
    -----------------------------------------------------------

    Points of the Sobol' sequence, with Owen scrambling of their digits and of their order. If the
    number of samples is a power of two, they are stratified in each pair of dimensions that a path
    draws together. The same holds for every aligned range of samples whose length is a power of
    two.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.
     * - dimensions
       - |int|
       - Number of dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more
         dimensions gets further random copies of the sequence. (Default: 4)
     * - blue_noise
       - |bool|
       - Whether the pixels share the points of one sequence, so that the errors of neighbouring
         pixels cancel: the noise that remains is fine-grained, and disappears when the image is
         blurred. (Default: false)
     * - film_width
       - |int|
       - Width of the image in pixels (of the crop window, including the border if that is sampled),
         for :monosp:`blue_noise` with :monosp:`mi.render` and an integrator of Mitsuba. Integrators
         of this package, :monosp:`mitsuba-ext render` and comparisons set it themselves. (Default:
         0, unknown)

    **Use it when** you would use :monosp:`multijitter`, above all if time, aperture and film
    together cause the noise, if the number of samples is not a square, or if the integrator learns
    from pilot samples, which are the first samples of the same sequence. **Not when** the
    integrator is :monosp:`reweighted_time` or another integrator that weights independent samples.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    With :monosp:`blue_noise`, the pixels are put in a Z-order in which the quarters of each square
    are shuffled. Each pixel takes the next points of one sequence, one for each of its samples.
    Squares of 2^k x 2^k pixels, up to 128 x 128, are therefore stratified together. Each pixel is
    unbiased by itself. **Use it for** previews of few samples, and for images that are scaled down,
    blurred or viewed from a distance. Use a power of two as the number of samples: with other
    numbers, the error of each single pixel is larger. **Not when** neighbouring pixels must be
    independent, for example for error bars computed from their scatter. :monosp:`adaptive` ignores
    this parameter: its pixels are independent.

    Source: direction numbers of S. Joe and F. Y. Kuo, *Constructing Sobol Sequences with Better
    Two-dimensional Projections*, SIAM J. Sci. Comput. 30(5), 2008; A. B. Owen, *Randomly Permuted
    (t,m,s)-Nets and (t,s)-Sequences*, 1995, with the hashes of B. Burley, *Practical Hash-based
    Owen Scrambling*, JCGT 9(4), 2020. Blue noise: A. G. M. Ahmed, P. Wonka, *Screen-Space
    Blue-Noise Diffusion of Monte Carlo Sampling Error via Hierarchical Ordering of Pixels*, ACM
    Transactions on Graphics 39(6), 2020.

    .. tabs::
        .. code-tab:: xml

            <sampler type="sobol_owen">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'sobol_owen',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = Sobol(self.read_dimensions(props))
        self.read_blue_noise(props)
