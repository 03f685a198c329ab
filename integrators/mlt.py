"""Metropolis light transport in the space of paths."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mitsuba_ext.composition.chain_integrator import ChainIntegrator
from mitsuba_ext.composition.path_mutations import (
    MOST,
    camera_samples,
    described,
    path_target,
    read_switches,
)
from mitsuba_ext.metropolis.chains.path_target import PathTarget
from mitsuba_ext.metropolis.chains.small_steps import SmallSteps
from mitsuba_ext.metropolis.chains.visits import ChainSettings, MetropolisRender
from mitsuba_ext.startup import registry


@registry.plugin
class PathMetropolis(ChainIntegrator):
    r"""
    .. _integrator-mlt:

    Path space Metropolis light transport (:monosp:`mlt`)
    -----------------------------------------------------

    Markov chains change light paths vertex by vertex, and stay where much light is found.

    .. pluginparameters::

     * - p_large
       - |float|
       - The probability of a new path. Of the rest, perturbations take most. (Default: 0.2)
     * - bidirectional_mutation
       - |bool|
       - Replace a part of the path by a random walk from both sides? (Default: true)
     * - lens_perturbation
       - |bool|
       - Move the place on the film, and all up to the first two vertices in a row that are neither
         mirrors nor smooth glass? (Default: true)
     * - multi_chain_perturbation
       - |bool|
       - The same, where the path is scattered by other surfaces in between? (Default: true)
     * - caustic_perturbation
       - |bool|
       - Move the direction in which light leaves its source, or the last diffuse surface before
         the one that the camera sees? It needs a sensor that light paths can be connected to.
         (Default: true)
     * - luminance_samples
       - |int|
       - Independent paths, at least, that estimate the brightness of the image, and from which
         chains start; a quarter of all mutations if that is more, or with a time limit as many as
         take a fifth of the time. (Default: 100000)
     * - chains
       - |int|
       - Chains, which run in parallel; there are no more than mutations. 0 stands for as many as
         suit the render: 1024, and more if each then makes 1024 mutations. (Default: 0)
     * - two_stage
       - |bool|
       - Estimate the brightness of parts of the image first, and spread mutations evenly over them
         instead of by brightness? (Default: false)
     * - (Common parameters)
       - |several|
       - Those of :class:`ChainIntegrator`: direct_samples, chain_file, max_depth, rr_depth,
         hide_emitters, timeout, aovs, checkpoint.

    ``spp`` is the number of mutations per pixel. New paths are independent samples besides, and
    count as such. Chains sample paths of up to 32 segments; camera samples find longer ones, if
    ``max_depth`` allows them.

    **Use it when** most light comes by ways that few random walks take: caustics, also behind
    glass and in mirrors; light through a gap. **Not when** :monosp:`path` or :class:`bdpt`
    converge well, or for noise that must look even (:class:`pssmlt`).

    The statistics hold the rates of acceptance. Participating media are refused.

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
        self.p_large = self.parameter(props, "p_large", 0.2, minimum=0.0, maximum=1.0)
        self.luminance_samples = self.read_luminance_samples(props)
        self.two_stage = self.parameter(props, "two_stage", False)
        self.chains = self.parameter(props, "chains", 0, minimum=0, maximum=1 << 20)
        self.switches = read_switches(self, props)

    def schedule(self, scene, sensor, samples, seed):
        if self.max_depth <= MOST:
            return super().schedule(scene, sensor, samples, seed)
        return camera_samples(self, self.setting(scene, sensor, samples, seed))

    def target(self, setting):
        return path_target(self, setting, self.switches)

    def chain_render(self, target: PathTarget, seed: int, *render: Any) -> MetropolisRender:
        settings = ChainSettings(
            self.chains, self.luminance_samples, self.p_large, SmallSteps(), True, self.two_stage,
            self.state_file(target, seed),
        )  # fmt: skip
        return MetropolisRender(settings, self, target, seed, *render)

    def parameters(self) -> dict[str, Any]:
        return {
            **super().parameters(),
            "chains": self.chains,
            "p_large": self.p_large,
            "luminance_samples": self.luminance_samples,
            **described(self.switches),
            "two_stage": self.two_stage,
        }
