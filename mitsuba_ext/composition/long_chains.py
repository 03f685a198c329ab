"""What integrators with long Markov chains share: parameters, and the render of the chains."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..metropolis.chains.path_target import PathTarget
from ..metropolis.chains.small_steps import SmallSteps
from ..metropolis.chains.target import ImageTarget
from ..metropolis.chains.visits import ChainSettings, MetropolisRender


class LongChains:
    """A mixin for subclasses of :class:`ChainIntegrator` whose chains last for the whole render.

    Attributes:
        p_large: The probability of a mutation that does not depend on the state of the chain.
        chains: Number of chains; 0 for a number that suits the render.
        luminance_samples: Least number of samples that estimate the brightness of the image.
        two_stage: Does a first stage make the visits even over the film?
        kelemen_style_weights: Are large steps also used as independent samples?
        steps: The small steps of primary samples.
    """

    kelemen_style_weights = True
    steps = SmallSteps()

    def read_chains(self, props: mi.Properties, p_large: float) -> None:
        """Reads the common parameters; ``p_large`` is the default of that parameter."""
        self.p_large = self.parameter(props, "p_large", p_large, minimum=0.0, maximum=1.0)
        self.luminance_samples = self.read_luminance_samples(props)
        self.two_stage = self.parameter(props, "two_stage", False)
        self.chains = self.parameter(props, "chains", 0, minimum=0, maximum=1 << 20)

    def chain_render(
        self, target: ImageTarget | PathTarget, seed: int, *render: Any
    ) -> MetropolisRender:
        settings = ChainSettings(
            self.chains, self.luminance_samples, self.p_large, self.steps,
            self.kelemen_style_weights, self.two_stage, self.state_file(target, seed),
        )  # fmt: skip
        return MetropolisRender(settings, self, target, seed, *render)

    def parameters(self) -> dict[str, Any]:
        return {
            **super().parameters(),
            "chains": self.chains,
            "p_large": self.p_large,
            "luminance_samples": self.luminance_samples,
            "two_stage": self.two_stage,
        }
