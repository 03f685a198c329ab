"""The techniques with weighted point sets."""

from __future__ import annotations

from .camera_numbers import WeightedNumbers
from .connections import Connections

TECHNIQUES = WeightedNumbers, Connections
