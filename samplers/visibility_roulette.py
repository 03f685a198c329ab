"""TODO"""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.decision_plugin import DecisionPlugin
from mitsuba_ext.composition.shadow_test import RejectedShadowRays


@registry.plugin
class VisibilityRoulettePlugin(DecisionPlugin):
    r"""TODO"""

    kind = RejectedShadowRays
