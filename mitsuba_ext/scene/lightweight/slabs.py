"""Constants and functions shared by all ray-box tests."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr

#: The maximum rounding error of the distance to a side of a box, relative to the two distances
#: whose difference it is.
ERROR = 2.0**-21

#: The minimum absolute value of a direction's components, so that their inverses are finite.
_TINY = 1e-18

D = TypeVar("D")


def with_inverse(d: D) -> tuple[D, D]:
    """A direction, or a component of one, without zeros, and its inverse."""
    d = dr.select(dr.abs(d) < _TINY, dr.mulsign(type(d)(_TINY), d), d)
    return d, dr.rcp(d)
