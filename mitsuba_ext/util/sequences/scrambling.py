"""Hashes, and nested uniform (Owen) scrambling of integers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mixed(x: mi.UInt32) -> mi.UInt32:
    """A hash: each bit of the result depends on all bits of ``x``.

    Source: C. Wellons, *Hash Prospector* (the two-round function with the least bias).
    """
    x = x ^ (x >> 16)
    x = x * 0x7FEB352D
    x = x ^ (x >> 15)
    x = x * 0x846CA68B
    return x ^ (x >> 16)


def flipped_upwards(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Flips each bit of ``x`` or not, by a hash of the bits below it and of the seed: nested
    uniform scrambling of integers whose bits are reversed.

    Source: S. Laine, T. Karras, *Stratified Sampling for Stochastic Transparency*, EGSR 2011;
    constants from N. Vegdahl, *Building a Better LK Hash*, 2021.
    """
    x = x ^ (x * 0x3D20ADEA)
    x = x + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def scrambled(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Nested uniform (Owen) scrambling: flips each bit of ``x`` or not, by a hash of the bits above
    it. Applied to coordinates, it preserves their stratification; applied to indices, it keeps
    aligned ranges of 2^k points together.

    Source: A. B. Owen, *Randomly Permuted (t,m,s)-Nets and (t,s)-Sequences*, 1995; by hashing as in
    B. Burley, *Practical Hash-based Owen Scrambling*, JCGT 9(4), 2020.
    """
    return dr.brev(flipped_upwards(dr.brev(x), seed))


def fraction(x: mi.UInt32) -> mi.Float:
    """The number x / 2^32 in [0, 1), rounded down."""
    return mi.Float(x >> 8) * 2.0**-24
