"""The probability of tracing a shadow ray, as a function of the learned visibility.

Source: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, sections 3.2 and
3.3.1 (= Guo's thesis, section 3.3.3.1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: Initial value of a map entry in the paper; with its law, the least probability of a test.
PAPER_EPSILON = 1e-4

#: Probabilities are rounded to this fixed point where they are summed.
_UNITS = 1024


@dataclass(frozen=True)
class RejectionLaw:
    """The probability p of testing a connection whose visibility is V.

    Attributes:
        law: ``affine`` for p = min(1, slope · V + floor), where V is an estimate with a prior;
            ``paper`` for p = max(V, 1e-4) (Eq. 2), where V is the plain share of successes.
        slope, floor: Parameters of the affine law; the other one ignores them.
    """

    law: str
    slope: float
    floor: float

    def probability(
        self, ratio: Callable[[], mi.Float], visibility: Callable[[], mi.Float]
    ) -> mi.Float:
        """The probability of each entry of a map.

        Parameters:
            ratio: Computes the share of the entry's tests that succeeded.
            visibility: Computes the estimate with a prior.
        """
        if self.law == "paper":
            return dr.maximum(ratio(), PAPER_EPSILON)
        return dr.minimum(1, self.slope * visibility() + self.floor)


def rejected_share(p: mi.Float, tests: mi.UInt32) -> float:
    """The share of the pilots' shadow rays that would not be traced.

    Parameters:
        p: The probability of a test, for each entry of a map.
        tests: How many shadow rays of the pilots each entry has.
    """
    # In integers: a share near the threshold must not depend on the order of a sum
    tests = mi.UInt64(tests)
    total, kept = dr.sum(tests), dr.sum(tests * mi.UInt64(p * _UNITS))
    return 1 - int(kept[0]) / (_UNITS * max(1, int(total[0])))
