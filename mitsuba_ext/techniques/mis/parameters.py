"""The slot ``mis``: the MIS weights of next event estimation and of lights that BSDF samples hit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from ...planning.technique import ParameterReader, Setting, Slots, Technique
from ...transport.mis import cutoff_heuristic_of, maximum_heuristic, power_heuristic_of
from ...transport.path_decisions import ConnectionsAlone, ScatteringAlone, Weights

#: Makes the weights of each heuristic from its parameters.
_MAKERS: Mapping[str, Callable[[Any], Weights]] = MappingProxyType(
    {
        "power": lambda p: Weights(power_heuristic_of(p.exponent)),
        "balance": lambda p: Weights(power_heuristic_of(1)),
        "cutoff": lambda p: Weights(cutoff_heuristic_of(p.threshold)),
        "maximum": lambda p: Weights(maximum_heuristic),
        "bsdf": lambda p: ScatteringAlone(),
        "light": lambda p: ConnectionsAlone(),
    }
)

#: Names of heuristics; the first is the one of ``path``.
HEURISTICS = tuple(_MAKERS)


class MisHeuristic(Technique):
    """The MIS weights of connections and of BSDF samples. The attributes are the parameters of the
    plugin ``mis_heuristic``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "mis_heuristic", True
    slots = ("mis",)
    words = {heuristic: {"heuristic": heuristic} for heuristic in HEURISTICS[1:]}

    def __init__(self, read: ParameterReader, heuristic: str = "") -> None:
        self.heuristic = heuristic or read("heuristic", HEURISTICS[0], choices=HEURISTICS)
        if self.heuristic == "power":
            self.exponent = read("exponent", 2.0, minimum=1.0, maximum=64.0)
        if self.heuristic == "cutoff":
            self.threshold = read("threshold", 0.1, minimum=0.0, maximum=1.0)

    def decision(self, setting: Setting) -> Any | None:
        return _MAKERS[self.heuristic](self)

    def describe(self, slots: Slots = MappingProxyType({})) -> str:
        is_plain = list(self.parameters(slots)) == ["heuristic"]
        return self.heuristic if is_plain else super().describe(slots)


TECHNIQUES = (MisHeuristic,)
