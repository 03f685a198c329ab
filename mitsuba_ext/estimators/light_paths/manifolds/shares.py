"""The shares of connections and of scattering in the light of a chain.

A trial finds a chain with an unknown probability p. Connections count the further trials until one
finds it again; their number n has the mean 1 / p. The variance of that estimate grows with 1 / p,
and the variance of light that scattering finds with 1 / ratio, where ``ratio`` is the density with
which scattering finds a chain / the density of the point on the light. So trial n counts
1 - n · ratio for connections, and trials beyond 1 / ratio do not count. Light that scattering finds
counts n · ratio (at most 1), where trial n is the first of others to find its chain. The means are

    Σ (1 - p)^(n-1) p (1 - n · ratio)   and   Σ (1 - p)^(n-1) p · n · ratio,

and their sum is 1, whatever p is. Chains that trials do not find are left to scattering. (In
caustic and ring, the variance is 1.00 times the one of the best weights for known p, which
connections and scattering cannot use.)
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Larger numbers of trials are not exact as floats.
_MOST = 1 << 24


def most_trials(ratio: mi.Float, limit: mi.UInt32) -> mi.UInt32:
    """The number of trials that count, at most ``limit``: a chain then lacks up to
    (1 - p)^``limit`` of its light."""
    return dr.minimum(mi.UInt32(dr.minimum(dr.rcp(ratio), _MOST)), limit)


def share_of_scattering(trials: mi.UInt32, ratio: mi.Float) -> mi.Float:
    """The share of scattering where the last of ``trials`` finds the chain."""
    return dr.minimum(mi.Float(trials) * ratio, 1)


def counted(trials: mi.UInt32, ratio: mi.Float) -> mi.Float:
    """What ``trials`` count for connections."""
    n = mi.Float(trials)
    return n - ratio * (0.5 * n * (n + 1))
