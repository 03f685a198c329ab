"""Multiple importance sampling: heuristics that weigh two techniques.

A heuristic is a function of two densities. The first belongs to the technique that took the sample,
the second to the other technique. The weights of both techniques add up to one wherever one of the
densities is positive. Where both vanish or overflow, the weight is 0.

Sources: E. Veach, PhD thesis, 1997, section 9.2; H. W. Jensen et al., *Monte Carlo Ray Tracing*,
SIGGRAPH 2003 course 44, section 5.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

#: (density of the technique that took the sample, density of the other one) → weight.
Heuristic = Callable[[Any, Any], Any]


def power_heuristic(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """The weight of a sample of density ``pdf_a`` that could have been drawn with ``pdf_b``
    (β = 2; Veach, PhD thesis, section 9.2.2.2); 0 where both densities vanish or overflow."""
    a, b = dr.square(pdf_a), dr.square(pdf_b)
    w = a / (a + b)
    return dr.select(dr.isfinite(w), w, 0)


def power_heuristic_of(exponent: float) -> Heuristic:
    """The power heuristic with another exponent β; 1 makes it the balance heuristic (Eq. 5.13 of
    the course)."""
    if exponent == 2:
        return power_heuristic

    def weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
        # The ratio does not overflow where powers of densities would
        ratio = pdf_b / pdf_a
        w = dr.rcp(1 + (ratio if exponent == 1 else dr.power(ratio, exponent)))
        return dr.select((pdf_a > 0) & dr.isfinite(ratio), w, 0)

    return weight


def cutoff_heuristic_of(threshold: float) -> Heuristic:
    """The cutoff heuristic (Veach, Eq. 9.11): a density below ``threshold`` times the other one
    counts as 0; beyond that, the balance heuristic."""
    balance = power_heuristic_of(1)

    def weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
        w = dr.select(pdf_b < threshold * pdf_a, 1, balance(pdf_a, pdf_b))
        return dr.select((pdf_a > 0) & (pdf_a >= threshold * pdf_b), w, 0)

    return weight


def maximum_heuristic(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """The maximum heuristic (Veach, Eq. 9.12; Eq. 5.12 of the course): the technique with the
    larger density has all weight; equal ones share it."""
    return dr.select(pdf_a > pdf_b, 1, dr.select((pdf_a == pdf_b) & (pdf_a > 0), mi.Float(0.5), 0))
