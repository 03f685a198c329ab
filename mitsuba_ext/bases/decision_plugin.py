"""The base class of plugins that a scene nests into a slot of an integrator.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import mitsuba as mi

from ..planning.technique import ParameterReader, Technique
from ..startup.registry import variant_bound


@variant_bound
class DecisionPlugin(mi.Sampler):
    """A decision of the walk, with its parameters. For Mitsuba it is a sampler, which can be nested
    in an integrator; it cannot be the sampler of a sensor.

    Attributes:
        kind: The class that reads the parameters of the scene.
        technique: The parameters that were read.
    """

    kind: type[Technique]

    def __init__(self, props: mi.Properties) -> None:
        # The base class reads no parameters, as those that it accepts have no effect here
        super().__init__(mi.Properties("independent"))
        self.name = props.plugin_name()
        self.technique = self.kind(ParameterReader(self.name, props))

    def to_string(self) -> str:
        values = self.technique.parameters().items()
        lines = ",\n".join(f"  {key} = {value}" for key, value in values)
        return f"{self.name}[\n{lines}\n]"

    def _refuse(self, *_arguments):
        slots = " or ".join(f'"{slot}"' for slot in self.technique.slots)
        raise RuntimeError(
            f'"{self.name}" is not a sampler for sensors: nest it in a "composed_path", as {slots}.'
        )

    clone = fork = seed = set_sample_count = next_1d = next_2d = _refuse


def register(kind: type[Technique]) -> None:
    """Registers a plugin that reads the parameters of a technique, in the active variant, by the
    technique's name."""
    plugin = type(kind.__name__, (DecisionPlugin,), {"kind": kind})
    mi.register_sampler(kind.name, lambda props: plugin(props))
