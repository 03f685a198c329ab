"""Metropolis light transport in the space of primary samples."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.long_chains import LongChains
from mitsuba_ext.bases.metropolis_integrator import MetropolisIntegrator
from mitsuba_ext.estimators.chains.target import ImageTarget
from mitsuba_ext.estimators.chains.visits import MetropolisRender
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.startup import registry


@registry.plugin
class PrimarySampleMetropolis(MetropolisIntegrator):
    r"""
    .. _integrator-pssmlt:

    Primary sample space Metropolis light transport (:monosp:`pssmlt`)
    ------------------------------------------------------------------

    Markov chains mutate the random numbers of a bidirectional path tracer (or of :monosp:`path`),
    and stay longer at numbers that find much light.

    .. pluginparameters::

     * - bidirectional
       - |bool|
       - Whether chains sample the paths of :class:`bdpt`; if not, they sample the paths of
         :monosp:`path`. A mutation of :class:`bdpt` takes about three times as long, and finds
         caustics of small lamps. (Default: true)
     * - p_large
       - |float|
       - The probability of a large step, which draws all random numbers anew. (Default: 0.3)
     * - luminance_samples
       - |int|
       - Minimum number of independent samples that estimate the brightness of the image, and from
         which chains start. A quarter of the number of mutations is used if that is more; with a
         time limit, as many as fit into a fifth of the time. (Default: 100000)
     * - kelemen_style_weights
       - |bool|
       - Whether large steps also serve as independent samples, weighted by the balance heuristic.
         This reduces the noise of dark pixels. (Default: true)
     * - chains
       - |int|
       - Number of chains, which run in parallel; at most the number of mutations. 0 stands for
         1024, or more if each of them still makes 1024 mutations (with light paths, 65536, or more
         if each still makes 64 mutations). (Default: 0)
     * - two_stage
       - |bool|
       - Whether to first estimate the brightness of the parts of the image, and then spread
         mutations evenly over these parts instead of in proportion to their brightness. (Default:
         false)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`MetropolisIntegrator`: direct_samples, chain_file, next_event,
         max_depth, rr_depth, hide_emitters, timeout, aovs, checkpoint.

    ``spp`` is the number of mutations per pixel.

    **Use it when** light takes paths that are rarely sampled, but whose neighbouring paths carry
    light too: caustics of lamps that are not too small, light through a gap. **Not when**
    :monosp:`path` converges well, or when noise must look even: neighbouring pixels depend on each
    other, and a chain that has found a rare bright path stays there for a long time, which shows as
    a spot. Only renders with different seeds show the true error (see :class:`variance`).

    The statistics contain the acceptance rates. Participating media are refused.

    Source: C. Kelemen, L. Szirmay-Kalos, G. Antal, F. Csonka, *A Simple and Robust Mutation
    Strategy for the Metropolis Light Transport Algorithm*, Eurographics 2002; D. Cline, PhD thesis,
    2007, section 7.13. Parameters: Mitsuba 0.6.

    .. tabs::
        .. code-tab:: xml

            <integrator type="pssmlt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'pssmlt',
            'max_depth': 8
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.long_chains = LongChains.read(self, props, p_large=0.3)
        uses_uniform = self.parameter(props, "kelemen_style_weights", True)
        self.long_chains.uses_uniform = uses_uniform

    def chain_render(self, target: ImageTarget, request: Request, *render: Any) -> MetropolisRender:
        return self.long_chains.render(self, target, request, *render)
