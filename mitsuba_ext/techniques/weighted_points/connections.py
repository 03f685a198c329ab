"""The slot ``connections``: to how many points on lights a vertex is connected."""

from __future__ import annotations

from typing import Any

from ...planning.costs import CONNECTIONS_PER_PATH
from ...planning.technique import ParameterReader, Setting, Technique
from ...util.pointsets import PATTERNS
from .weighted_connections import NoFirstConnections, WeightedConnections
from .weighted_sets import MOST_SLOW_POINTS, SLOW_PATTERN, WEIGHTS, WeightedSets

#: The most connections of a vertex.
_MOST = 4096


class Connections(Technique):
    """The number of connections of a vertex, and the point sets that choose them. The attributes
    are the parameters of the plugin ``weighted_connections``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "weighted_connections", True
    slots, values = ("connections",), "a number"

    def __init__(self, read: ParameterReader) -> None:
        self.pattern = read("pattern", "hammersley", choices=PATTERNS)
        self.weights = read("weights", "none", choices=WEIGHTS)
        most = MOST_SLOW_POINTS if self.pattern == SLOW_PATTERN else _MOST
        self.count = read("count", 16, minimum=0, maximum=most)
        self.vertices = read("vertices", "first", choices=("first", "all"))

    @classmethod
    def of_value(cls, plugin: str, slot: str, value: Any) -> Connections | None:
        if type(value) is not int:
            return None
        return cls(ParameterReader.of_defaults(plugin, {"count": slot}, count=value))

    @property
    def sample_cost(self) -> int:
        return max(1, self.count // CONNECTIONS_PER_PATH)

    def decision(self, setting: Setting) -> Any | None:
        if not setting.scene.emitters() or setting.max_depth < 2:
            return None
        everywhere = self.vertices == "all"
        if self.count == 0:
            return NoFirstConnections(everywhere)
        sets = WeightedSets(self.pattern, self.weights, self.count, 2, setting.seed)
        return WeightedConnections(sets, everywhere)
