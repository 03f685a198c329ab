"""Sobol' sequence with Owen scrambling."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext import registry
from mitsuba_ext.sequences.sequence_sampler import SequenceSampler
from mitsuba_ext.sequences.sobol import Sobol


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

    **Use it when** you would use :monosp:`multijitter`, above all if time, aperture and film make
    the noise together, if the number of samples is no square, or if pilots learn: they are the
    first samples of the same sequence. **Not when** the integrator is :monosp:`reweighted_time` or
    another one that gives independent samples weights.

    Each pixel has points of its own, each seed has others. For any integrator; those of Mitsuba
    that split a render into passes (:monosp:`samples_per_pass`) stratify over passes only in part.

    Source: direction numbers of S. Joe and F. Y. Kuo, *Constructing Sobol Sequences with Better
    Two-dimensional Projections*, SIAM J. Sci. Comput. 30(5), 2008; A. B. Owen, *Randomly Permuted
    (t,m,s)-Nets and (t,s)-Sequences*, 1995, by the hashes of B. Burley, *Practical Hash-based Owen
    Scrambling*, JCGT 9(4), 2020.

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
