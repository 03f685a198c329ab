"""What the tests of all boxes have in common."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr

#: Rounding errors of the distance to a side of a box, relative to the distances of which it is the
#: difference.
ERROR = 2.0**-21

#: Components of directions that are smaller are replaced by this: their inverse is finite.
_TINY = 1e-18

D = TypeVar("D")


def with_inverse(d: D) -> tuple[D, D]:
    """A direction, or a component of it, without zeros, and its inverse."""
    d = dr.select(dr.abs(d) < _TINY, dr.mulsign(type(d)(_TINY), d), d)
    return d, dr.rcp(d)
