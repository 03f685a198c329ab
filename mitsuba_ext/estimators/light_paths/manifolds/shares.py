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

The trials of a connection also tell what scattering alone would cost. Let F be the light of a chain
/ the density of the point on the light. Scattering brings F / ratio with the density ratio, where
shares take it from F² / ratio to F² / ratio · Σ (1 - p)^(n-1) p (n · ratio)² in the second moment
of a path. The difference, F² / ratio · Σ (1 - p)^(n-1) p (1 - (n · ratio)²), is the mean over
connections, which find the chain with probability p, of

    F² / ratio · Σ_{k ≤ n} (1 - (k · ratio)²),

because trial k is made with probability (1 - p)^(k-1). Connections add the square of what they
count, F² (Σ_{k ≤ n} (1 - k · ratio))². So connections alone, which find light of which scattering
may show nothing in a pilot, tell by how much they reduce the variance.
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


def taken_from_scattering(trials: mi.UInt32, ratio: mi.Float) -> mi.Float:
    """By how much a connection with this number of ``trials`` reduces the second moment of light
    that scattering finds, in units of F² / ratio."""
    n = mi.Float(trials)
    return n - dr.square(ratio) * (n * (n + 1) * (2 * n + 1) / 6)
