"""Faure sequence."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.faure import Faure


@registry.plugin
class FaureSampler(SequenceSampler):
    r"""
    .. _sampler-faure:

    Faure sequence (:monosp:`faure`)
    --------------------------------

    Points of the Faure sequence. If the number of samples is a power of its base (2, 5, 7 or 11 for
    2, 4, 6 or 8 dimensions), they are stratified as well as possible in all projections onto any of
    its dimensions.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.
     * - dimensions
       - |int|
       - Number of dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more
         dimensions gets further random copies of the sequence. (Default: 4)

    **Use it when** the number of samples is a power of the base, for example 25. **Not when** it is
    any other number: :monosp:`sobol_owen` then has less error.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    Source: H. Faure, *Discrépance de suites associées à un système de numération (en dimension s)*,
    Acta Arithmetica 41, 1982.

    .. tabs::
        .. code-tab:: xml

            <sampler type="faure">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'faure',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = Faure(self.read_dimensions(props))
