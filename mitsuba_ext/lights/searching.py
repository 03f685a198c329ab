"""Choosing an entry of a table by its weight: binary search in running sums, and alias tables."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

#: The largest number below one.
ONE_MINUS_EPSILON = 1 - 2**-24


def first_above(
    cumulative: mi.Float,
    first: mi.UInt32,
    last: mi.UInt32,
    x: mi.Float,
    active: mi.Bool,
    longest: int,
) -> mi.UInt32:
    """The first index of [first, last] whose entry exceeds ``x``; ``last`` if none does. No range
    has more than ``longest`` entries: that fixes the number of steps, all of them without a branch.
    """
    index = mi.UInt32(first)
    step = 1 << max(0, (longest - 1).bit_length() - 1) if longest > 1 else 0
    while step > 0:
        probe = index + (step - 1)
        inside = active & (probe < last)
        below = inside & (dr.gather(mi.Float, cumulative, probe, inside) <= x)
        index = dr.select(below, index + step, index)
        step >>= 1
    return index


def alias_tables(weights: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Walker's alias tables for consecutive groups of positive weights, all groups at once.

    An entry chosen uniformly in its group keeps a random number below its threshold and gives all
    others to its alias. Lighter entries give what they lack to the heavier ones in their order, as
    Vose's algorithm does; here, running sums tell which (Hübschle-Schneider and Sanders 2019).

    Args:
        weights: Of all entries; shape [n].
        sizes: Number of entries of each group; their sum is n.

    Returns:
        The threshold of each entry, in [0, 1], and the index of its alias, in [0, n).
    """
    group = np.repeat(np.arange(len(sizes)), sizes)
    mean = np.bincount(group, weights, len(sizes)) / np.maximum(sizes, 1)
    relative = weights / mean[group]
    threshold, alias = np.minimum(relative, 1), np.arange(len(weights))
    # Sums that should be equal differ by rounding: the excess of a hardly heavy entry is none
    is_heavy = relative > 1 + 1e-9
    heavy_count = np.bincount(group, is_heavy, len(sizes)).astype(int)
    light_count = np.where(heavy_count > 0, sizes - heavy_count, 0)
    threshold[(heavy_count == 0)[group]] = 1
    heavy = np.flatnonzero(is_heavy)
    light = np.flatnonzero(~is_heavy & (heavy_count > 0)[group])
    if len(heavy) == 0:
        return threshold, alias
    excess, lack = np.cumsum(relative[heavy] - 1), np.cumsum(1 - threshold[light])

    def within_group(index: np.ndarray, count: np.ndarray, user: np.ndarray) -> np.ndarray:
        """Limits indices of entries, of which the groups have ``count``, to the users' groups."""
        end = np.cumsum(count)
        return np.clip(index, (end - count)[group[user]], (end - 1)[group[user]])

    # A light entry is served by the first heavy one that has something left
    before = np.concatenate([[0.0], lack[:-1]])
    server = np.searchsorted(excess, before, side="right")
    alias[light] = heavy[within_group(server, heavy_count, light)]

    # It may give more than it has: then the next heavy one serves it. The last one keeps the rest.
    final = within_group(np.searchsorted(lack, excess), light_count, heavy)
    threshold[heavy] = np.clip(1 + excess - lack[final], 0, 1)
    alias[heavy[:-1]] = heavy[1:]
    last = heavy[np.append(group[heavy[1:]] != group[heavy[:-1]], True)]
    threshold[last], alias[last] = 1, last
    return threshold, alias
