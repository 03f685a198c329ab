"""The base class of integrators with Markov chains in primary sample space.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from ..estimators.chains.target import ImageTarget
from ..estimators.light_paths.light_side import LightSide
from ..estimators.light_paths.path_tracer import BidirectionalPathTracer
from ..planning.technique import Setting, Technique
from ..startup.registry import variant_bound
from ..transport.path_program import PathProgram
from ..transport.without_lengths import WithoutLengths
from .chain_integrator import ChainIntegrator
from .slots import read_slot


@variant_bound
class MetropolisIntegrator(ChainIntegrator):
    """An integrator with Markov chains that mutate the primary samples of paths.

    .. pluginparameters::

     * - next_event
       - |string| or |decision|
       - How points on lights are chosen, as in :class:`composed_path`. Choices that learn are not
         accepted. (Default: as in :monosp:`path`)
     * - (Common parameters)
       - |several|
       - Those of :class:`ChainIntegrator`: direct_samples, chain_file, max_depth, rr_depth,
         hide_emitters, timeout, aovs, checkpoint.

    Attributes:
        bidirectional: Whether chains sample paths from both ends.
        is_bidirectional: The default of ``bidirectional``.
    """

    is_bidirectional = True
    has_light_paths = True

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.bidirectional = self.parameter(props, "bidirectional", self.is_bidirectional)
        self.fill(props, next_event=self._unlearned(props, "next_event"))

    def _unlearned(self, props: mi.Properties, slot: str) -> Technique | None:
        parameters = read_slot(self.name, props, slot)
        if parameters is not None and parameters.pilot_spp:
            raise ValueError(
                f'"{self.name}": the parameter "{slot}" is "{parameters.name}", which learns from '
                f"pilots; chains need a choice that does not, such as \"spatial\""
            )
        return parameters

    def target(self, setting: Setting) -> ImageTarget | None:
        """The target distribution of the chains; ``None`` if no path is left for them to find."""
        scene, sensor = setting.scene, setting.sensor
        least = 3 if self.finds_direct else 1
        if not scene.emitters() or self.max_depth < least:
            return None
        if not self.bidirectional or self.max_depth < 2:
            program = WithoutLengths(PathProgram(), 1, 2) if self.finds_direct else None
            walk = self.composed_walk(setting, self.max_depth, program)
            return ImageTarget(scene, sensor, walk, setting.spp)
        side = LightSide.of(self.name, scene, sensor)
        walk = self.composed_walk(setting, self.max_depth)
        chosen = self.slots.get("next_event")
        next_event = side.next_event(walk.next_event if chosen else None)
        if next_event:
            walk = replace(walk, next_event=next_event)
        tracer = BidirectionalPathTracer(
            walk, side.emission, side.sensor, 1, is_alone=True, skips_direct=self.finds_direct
        )
        return ImageTarget(scene, sensor, tracer, setting.spp, has_light_paths=True)
