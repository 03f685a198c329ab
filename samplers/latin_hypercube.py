"""Latin hypercube."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.latin_hypercube import LatinHypercube


@registry.plugin
class LatinHypercubeSampler(SequenceSampler):
    r"""
    .. _sampler-latin_hypercube:

    Latin hypercube (:monosp:`latin_hypercube`)
    -------------------------------------------

    Each random number of a path is stratified separately: [0, 1) is divided into as many intervals
    as there are samples, and each interval gets one number.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.

    **Use it when** you compare sequences. **Not when** you want the lowest error:
    :monosp:`sobol_owen` stratifies pairs of numbers as well.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    Source: M. D. McKay, R. J. Beckman, W. J. Conover, *A Comparison of Three Methods for Selecting
    Values of Input Variables in the Analysis of Output from a Computer Code*, Technometrics 21(2),
    1979.

    .. tabs::
        .. code-tab:: xml

            <sampler type="latin_hypercube">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'latin_hypercube',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = LatinHypercube()
