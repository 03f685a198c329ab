"""Sobol' sequence with Owen scrambling."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.sequences.sequence_sampler import SequenceSampler
from mitsuba_ext.sequences.sobol import Sobol
from mitsuba_ext.startup import registry


@registry.plugin
class SobolSampler(SequenceSampler):
    r"""
    .. _sampler-sobol_owen:

    Sobol' sequence with Owen scrambling (:monosp:`sobol_owen`)
    -----------------------------------------------------------

    Points of the Sobol' sequence. Their digits and their order are scrambled as Owen does: all
    numbers of samples that are powers of two, and every aligned range of so many samples, are
    stratified in each pair of dimensions that a path draws at once.

    .. pluginparameters::

     * - (Common parameters)
       - |-|
       - Those of all samplers of this package.
     * - dimensions
       - |int|
       - Dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more of them gets
         further random copies of the sequence. (Default: 4)
     * - blue_noise
       - |bool|
       - Whether the pixels share the points of one sequence, so that the errors of neighbouring
         pixels cancel: what is left is fine-grained noise, which blurs away. (Default: false)
     * - film_width
       - |int|
       - Width of the image in pixels (of the crop window, with the border where that is sampled),
         for :monosp:`blue_noise` with :monosp:`mi.render` and an integrator of Mitsuba. Those of
         this package, :monosp:`mitsuba-ext render` and comparisons find it out. (Default: 0, not
         known)

    **Use it when** you would use :monosp:`multijitter`, above all if time, aperture and film make
    the noise together, if the number of samples is no square, or if pilots learn: they are the
    first samples of the same sequence. **Not when** the integrator is :monosp:`reweighted_time` or
    another one that gives independent samples weights.

    Each pixel has points of its own, each seed has others. For any integrator; those of Mitsuba
    that split a render into passes (:monosp:`samples_per_pass`) stratify over passes only in part.

    With :monosp:`blue_noise`, the pixels are put in a Z-order in which the quarters of each square
    are shuffled, and each takes the next points of one sequence, as many as it has samples. So
    squares of 2^k x 2^k pixels are stratified together, up to 128 x 128. Each pixel is unbiased by
    itself. **Use it for** previews of few samples, and for images that are scaled down, blurred or
    looked at from afar. Powers of two are the best numbers of samples: with others, a pixel has
    more error by itself. **Not when** neighbouring pixels must be independent, as for error bars
    that come from their scatter. :monosp:`adaptive` leaves pixels independent.

    Source: direction numbers of S. Joe and F. Y. Kuo, *Constructing Sobol Sequences with Better
    Two-dimensional Projections*, SIAM J. Sci. Comput. 30(5), 2008; A. B. Owen, *Randomly Permuted
    (t,m,s)-Nets and (t,s)-Sequences*, 1995, by the hashes of B. Burley, *Practical Hash-based Owen
    Scrambling*, JCGT 9(4), 2020. Blue noise: A. G. M. Ahmed, P. Wonka, *Screen-Space Blue-Noise
    Diffusion of Monte Carlo Sampling Error via Hierarchical Ordering of Pixels*, ACM Transactions
    on Graphics 39(6), 2020.

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
