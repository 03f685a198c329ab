"""Halton sequence."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.halton import Halton


@registry.plugin
class HaltonSampler(SequenceSampler):
    r"""
    .. _sampler-halton:

    Halton sequence (:monosp:`halton`)
    ----------------------------------

    Points of the Halton sequence: the radical inverse of the sample's index, in a different prime
    base for each dimension, with randomly permuted digits.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.
     * - dimensions
       - |int|
       - Number of dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more
         dimensions gets further random copies of the sequence. (Default: 4)

    **Use it when** you compare sequences. **Not when** time matters: :monosp:`sobol_owen` is
    faster.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    Source: J. H. Halton, *On the Efficiency of Certain Quasi-random Sequences of Points in
    Evaluating Multi-dimensional Integrals*, Numerische Mathematik 2, 1960.

    .. tabs::
        .. code-tab:: xml

            <sampler type="halton">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'halton',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = Halton(self.read_dimensions(props))
