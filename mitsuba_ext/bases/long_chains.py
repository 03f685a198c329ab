"""What integrators with long Markov chains share: parameters, and the render of the chains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mitsuba as mi

from ..estimators.chains.path_target import PathTarget
from ..estimators.chains.small_steps import SmallSteps
from ..estimators.chains.target import ImageTarget
from ..estimators.chains.visits import ChainSettings, MetropolisRender
from ..rendering.request import Request

if TYPE_CHECKING:
    from .chain_integrator import ChainIntegrator


@dataclass
class LongChains:
    """Chains that last for the whole render.

    Attributes:
        chains: Number of chains; 0 for a number that suits the render.
        luminance_samples: Least number of samples that estimate the brightness of the image.
        p_large: The probability of a mutation that does not depend on the state of the chain.
        two_stage: Whether a first stage makes the visits even over the film.
        uses_uniform: Whether large steps are also used as independent samples.
        steps: The small steps of primary samples.
    """

    chains: int
    luminance_samples: int
    p_large: float
    two_stage: bool
    uses_uniform: bool = True
    steps: SmallSteps = SmallSteps()

    @classmethod
    def read(
        cls, integrator: ChainIntegrator, props: mi.Properties, p_large: float
    ) -> LongChains:
        """Reads the parameters of an integrator; ``p_large`` is the default of that parameter."""
        return cls(
            integrator.parameter(props, "chains", 0, minimum=0, maximum=1 << 20),
            integrator.read_luminance_samples(props),
            integrator.parameter(props, "p_large", p_large, minimum=0.0, maximum=1.0),
            integrator.parameter(props, "two_stage", False),
        )

    def render(
        self,
        integrator: ChainIntegrator,
        target: ImageTarget | PathTarget,
        request: Request,
        *render: Any,
    ) -> MetropolisRender:
        """Makes the render of the chains. The parameters after the integrator are those of
        :meth:`ChainIntegrator.chain_render`."""
        settings = ChainSettings(
            self.chains, self.luminance_samples, self.p_large, self.steps, self.uses_uniform,
            self.two_stage, integrator.state_file(target, request.seed),
        )  # fmt: skip
        return MetropolisRender(settings, integrator, target, request, *render)
