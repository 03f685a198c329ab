"""Rank-1 lattice."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.lattice import Lattice


@registry.plugin
class LatticeSampler(SequenceSampler):
    r"""
    .. _sampler-lattice:

    Rank-1 lattice (:monosp:`lattice`)
    ----------------------------------

    Multiples of one vector, modulo 1, with a random shift in each dimension. The vector works well
    for any power of two of samples.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.
     * - dimensions
       - |int|
       - Number of dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more
         dimensions gets further random copies of the sequence. (Default: 4)

    **Use it when** radiance is smooth within a pixel. **Not when** edges cross most pixels: points
    of a lattice lie in rows.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    Source: R. Cools, F. Y. Kuo, D. Nuyens, *Constructing Embedded Lattice Rules for Multivariate
    Integration*, SIAM J. Sci. Comput. 28(6), 2006.

    .. tabs::
        .. code-tab:: xml

            <sampler type="lattice">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'lattice',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = Lattice(self.read_dimensions(props))
