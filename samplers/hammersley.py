"""Hammersley set."""

from __future__ import annotations

import mitsuba as mi

from mitsuba_ext.bases.sequence_sampler import SequenceSampler
from mitsuba_ext.startup import registry
from mitsuba_ext.util.sequences.halton import Hammersley


@registry.plugin
class HammersleySampler(SequenceSampler):
    r"""
    .. _sampler-hammersley:

    Hammersley set (:monosp:`hammersley`)
    -------------------------------------

    Points of the Hammersley set: the first dimension is the sample's index divided by the number of
    samples, and the others are the same as in :monosp:`halton`.

    .. pluginparameters::

     * - (Common parameters)
       - |int|
       - The parameters of :class:`SequenceSampler`: sample_count, seed.
     * - dimensions
       - |int|
       - Number of dimensions that are stratified together: 2, 4, 6 or 8. A path that draws more
         dimensions gets further random copies of the sequence. (Default: 4)

    **Use it when** you compare sequences. **Not when** a render may be cut short by
    :monosp:`timeout`: the first samples alone are not spread evenly.

    Each pixel and each seed has its own points. All integrators can use this sampler. If an
    integrator of Mitsuba splits a render into passes (:monosp:`samples_per_pass`), samples are
    stratified over all passes only in part.

    Source: J. M. Hammersley, *Monte Carlo Methods for Solving Multivariable Problems*, Annals of
    the New York Academy of Sciences 86, 1960.

    .. tabs::
        .. code-tab:: xml

            <sampler type="hammersley">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'hammersley',
            'sample_count': 64
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sequence = Hammersley(self.read_dimensions(props))
