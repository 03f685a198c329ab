"""TODO"""

from __future__ import annotations

from mitsuba_ext import registry
from mitsuba_ext.composition.camera_numbers import WeightedNumbers
from mitsuba_ext.composition.decision_plugin import DecisionPlugin


@registry.plugin
class WeightedNumbersPlugin(DecisionPlugin):
    r"""TODO"""

    kind = WeightedNumbers
