"""TODO"""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.decision_plugin import DecisionPlugin
from mitsuba_ext.composition.next_event import LearnedLights


@registry.plugin
class LearnedLightsPlugin(DecisionPlugin):
    r"""TODO"""

    kind = LearnedLights
