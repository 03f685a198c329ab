"""TODO"""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.connections import Connections
from mitsuba_ext.composition.decision_plugin import DecisionPlugin


@registry.plugin
class WeightedConnectionsPlugin(DecisionPlugin):
    r"""TODO"""

    kind = Connections
