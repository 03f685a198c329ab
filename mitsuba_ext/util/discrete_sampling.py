"""Chooses entries of tables by weight: binary search in running sums, and alias tables."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: The largest number below one.
ONE_MINUS_EPSILON = 1 - 2**-24

#: The fixed-point number that stands for the weight 1 in an alias table.
_ONE = 2.0**32


def first_above(
    cumulative: mi.Float | mi.UInt64,
    first: mi.UInt32,
    last: mi.UInt32,
    x: mi.Float | mi.UInt64,
    active: mi.Bool,
    longest: int,
    reaches: bool = False,
) -> mi.UInt32:
    """The first index of [first, last] whose entry exceeds ``x`` (with ``reaches``, or equals it);
    ``last`` if none does. ``longest`` is the maximum length of a range, which sets the number of
    steps. The steps have no branches.
    """
    index = mi.UInt32(first)
    step = 1 << max(0, (longest - 1).bit_length() - 1) if longest > 1 else 0
    while step > 0:
        probe = index + (step - 1)
        inside = active & (probe < last)
        value = dr.gather(type(cumulative), cumulative, probe, inside)
        below = inside & ((value < x) if reaches else (value <= x))
        index = dr.select(below, index + step, index)
        step >>= 1
    return index


def alias_tables(
    relative: mi.Float64, first: mi.UInt32, last: mi.UInt32, longest: int
) -> tuple[mi.Float, mi.UInt32]:
    """Walker's alias tables for consecutive groups of weights, all groups at once.

    To sample a group, choose an entry uniformly; take it if a random number is below its threshold,
    else take its alias. As in Vose's algorithm, an entry lighter than the mean gets a heavier one
    as its alias, in the order of the entries. Running sums find the aliases of all entries in
    parallel (Hübschle-Schneider and Sanders 2019).

    Args:
        relative: The weights of all entries, in units of the mean of their group; shape [n].
        first, last: The indices at which the group of each entry begins and ends; shape [n].
        longest: The maximum number of entries of a group.

    Returns:
        The threshold of each entry, in [0, 1], and the index of its alias, in its group.
    """
    # In fixed point, sums are exact in any order of addition, and running sums never decrease
    relative = mi.UInt64(relative * _ONE + 0.5)
    one = dr.opaque(mi.UInt64, int(_ONE))
    excess = _running_sum(dr.maximum(relative, one) - one, first)
    lack = _running_sum(one - dr.minimum(relative, one), first)
    entry = dr.arange(mi.UInt32, len(relative))
    is_heavy = relative > one
    # The alias of a light entry is the first heavy one with some excess left. A heavy entry may
    # give more than its excess: it then becomes a light one, with the next heavy entry as alias
    served = dr.select(is_heavy, excess, dr.gather(mi.UInt64, lack, entry - 1, entry > first))
    alias = first_above(excess, first, last, served, mi.Bool(True), longest)
    final = first_above(lack, first, last, excess, is_heavy, longest, reaches=True)
    given = dr.gather(mi.UInt64, lack, final, is_heavy)
    threshold = dr.select(is_heavy, one + excess - dr.minimum(given, one + excess), relative)
    # Excess and lack of a group differ by rounding: the last entries may find no alias
    found = dr.gather(mi.UInt64, excess, alias) > served
    threshold = dr.minimum(mi.Float(mi.Float64(threshold) / _ONE), 1)
    return dr.select(found, threshold, 1), dr.select(found, alias, entry)


def _running_sum(values: mi.UInt64, first: mi.UInt32) -> mi.UInt64:
    """For each entry, the sum of the values from the ``first`` of its group to its own."""
    total = dr.cumsum(values)
    total -= dr.gather(mi.UInt64, total, first - 1, first > 0)
    dr.eval(total)
    return total
