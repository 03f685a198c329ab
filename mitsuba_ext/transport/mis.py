"""Multiple importance sampling."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def power_heuristic(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """The weight of a sample of density ``pdf_a`` that could have been drawn with ``pdf_b``
    (β = 2; Veach, PhD thesis, section 9.2.2.2); 0 where both densities vanish or overflow."""
    a, b = dr.square(pdf_a), dr.square(pdf_b)
    w = a / (a + b)
    return dr.select(dr.isfinite(w), w, 0)
