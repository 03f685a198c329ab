"""TODO"""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.decision_plugin import DecisionPlugin
from mitsuba_ext.composition.directions import Guided


@registry.plugin
class GuidedDirectionsPlugin(DecisionPlugin):
    r"""TODO"""

    kind = Guided
