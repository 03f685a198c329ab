"""Metropolis light transport in the space of paths."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.bases.chain_integrator import ChainIntegrator
from mitsuba_ext.bases.long_chains import LongChains
from mitsuba_ext.bases.path_mutations import (
    MOST,
    camera_samples,
    path_target,
    read_switches,
)
from mitsuba_ext.estimators.chains.path_target import PathTarget
from mitsuba_ext.estimators.chains.visits import MetropolisRender
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.startup import registry


@registry.plugin
class PathMetropolis(ChainIntegrator):
    r"""
    .. _integrator-mlt:

    Path space Metropolis light transport (:monosp:`mlt`)
    -----------------------------------------------------

    Markov chains mutate light paths vertex by vertex, and stay longer at paths that carry much
    light.

    .. pluginparameters::

     * - p_large
       - |float|
       - The probability of a new, independent path. Most of the other mutations are perturbations.
         (Default: 0.2)
     * - bidirectional_mutation
       - |bool|
       - Whether to replace a part of the path by a random walk from both sides. (Default: true)
     * - lens_perturbation
       - |bool|
       - Whether to perturb the position on the film, and the path up to its first two consecutive
         vertices that are neither mirrors nor smooth glass. (Default: true)
     * - multi_chain_perturbation
       - |bool|
       - Whether to do the same for paths that other surfaces scatter in between. (Default: true)
     * - caustic_perturbation
       - |bool|
       - Whether to perturb the direction in which light leaves its source, or the last diffuse
         surface before the one that the camera sees. This requires a sensor to which light paths
         can be connected. (Default: true)
     * - luminance_samples
       - |int|
       - Minimum number of independent paths that estimate the brightness of the image, and from
         which chains start. A quarter of the number of mutations is used if that is more; with a
         time limit, as many as fit into a fifth of the time. (Default: 100000)
     * - chains
       - |int|
       - Number of chains, which run in parallel; at most the number of mutations. 0 stands for
         1024, or more if each of them still makes 1024 mutations. (Default: 0)
     * - two_stage
       - |bool|
       - Whether to first estimate the brightness of the parts of the image, and then spread
         mutations evenly over these parts instead of in proportion to their brightness. (Default:
         false)
     * - (Common parameters)
       - |several|
       - The parameters of :class:`ChainIntegrator`: direct_samples, chain_file, max_depth,
         rr_depth, hide_emitters, timeout, aovs, checkpoint.

    ``spp`` is the number of mutations per pixel. New paths also serve as independent samples.
    Chains sample paths of up to 32 segments; camera samples find longer ones, if ``max_depth``
    allows them.

    **Use it when** most light takes paths that random walks rarely find: caustics, including
    caustics behind glass and in mirrors; light through a gap. **Not when** :monosp:`path` or
    :class:`bdpt` converge well, or when noise must look even (see :class:`pssmlt`).

    The statistics contain the acceptance rates. Participating media are refused, and so
    are curves whose BSDF transmits light, such as :monosp:`hair` (use :class:`pssmlt`).

    Source: E. Veach, L. Guibas, *Metropolis Light Transport*, SIGGRAPH 1997; D. Cline, PhD thesis,
    2007, section 7.12. Parameters: Mitsuba 0.6.

    .. tabs::
        .. code-tab:: xml

            <integrator type="mlt">
                <integer name="max_depth" value="8"/>
            </integrator>

        .. code-tab:: python

            'type': 'mlt',
            'max_depth': 8
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.long_chains = LongChains.read(self, props, p_large=0.2)
        self.switches = read_switches(self, props)

    def schedule(self, request, samples, learning):
        if self.max_depth <= MOST:
            return super().schedule(request, samples, learning)
        return camera_samples(self, self.setting(request, sum(samples)))

    def target(self, setting):
        return path_target(self, setting, self.switches)

    def chain_render(self, target: PathTarget, request: Request, *render: Any) -> MetropolisRender:
        return self.long_chains.render(self, target, request, *render)
