"""Small steps: mutations that change a primary sample slightly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: The largest number below 1.
_BELOW_ONE = 1 - 2.0**-24


@dataclass(frozen=True)
class SmallSteps:
    """Moves a number in [0, 1) by a distance between ``low`` and ``high``, up or down with equal
    probability. A number that leaves the interval re-enters it at the other end. The density of the
    distance is proportional to 1 / distance. A move and its reverse have the same density.

    Source: C. Kelemen, L. Szirmay-Kalos, G. Antal, F. Csonka, *A Simple and Robust Mutation
    Strategy for the Metropolis Light Transport Algorithm*, Eurographics 2002, section 3.2;
    D. Cline, PhD thesis, 2007, section 7.13.

    Parameters:
        low, high: The smallest and the largest distance; 0 < low < high <= 1/2.
    """

    low: float = 1 / 1024
    high: float = 1 / 64

    def move(self, value: mi.Float, sample: mi.Float) -> mi.Float:
        """The moved ``value``; the random number ``sample``, in [0, 1), chooses the move."""
        is_up = sample < 0.5
        sample = 2 * sample - dr.select(is_up, 0, 1)
        distance = self.high * dr.exp(-math.log(self.high / self.low) * sample)
        moved = value + dr.select(is_up, distance, -distance)
        # Rounding may yield 1
        return dr.minimum(moved - dr.floor(moved), _BELOW_ONE)
