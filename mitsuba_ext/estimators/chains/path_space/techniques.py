"""The techniques that make new paths: the length, and the number of vertices from either end."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....util.arrays import from_numpy
from ....util.discrete_sampling import ONE_MINUS_EPSILON, first_above

#: The ratio between the probabilities of successive path lengths in the initial distribution.
_DECAY = 0.7

#: The weight of the initial distribution in a learned one. No technique is excluded, because some
#: rarely find light but then find bright paths.
_FLOOR = 0.3


# Not a dataclass: Dr.Jit would treat one that a loop uses as part of the loop's state
class Techniques:
    """A distribution over techniques. The technique of a path with n segments is the number of its
    vertices made from the camera, 0 to n; the others are made from the light.

    Parameters:
        least, most: The minimum and maximum lengths of paths, in segments.
    """

    def __init__(self, least: int, most: int) -> None:
        self._least, self._most = least, most
        lengths = np.arange(least, most + 1)
        self._lengths = np.repeat(lengths, lengths + 1)
        self._grown = np.concatenate([np.arange(n + 1) for n in lengths])
        chance = _DECAY ** (self._lengths - least) / (self._lengths + 1)
        # Only camera paths find lights that are directly visible
        chance[(self._lengths == 1) & (self._grown == 0)] = 0
        self._first = chance / chance.sum()
        self._tables = [from_numpy(mi.UInt32, a) for a in (self._lengths, self._grown)]
        # The index of the first technique of each length
        starts = np.concatenate([np.zeros(least), np.cumsum([0, *(lengths + 1)])])[: most + 1]
        self._starts = from_numpy(mi.UInt32, starts)
        self._set(self._first)

    def _set(self, chance: np.ndarray) -> None:
        self._chance = chance
        self._sums = from_numpy(mi.Float, np.cumsum(chance))
        self._logs = from_numpy(mi.Float, np.log(np.maximum(chance, 1e-30)))
        dr.eval(self._sums, self._logs)

    def kernel_state(self) -> tuple:
        """The arrays and constants on which kernels depend."""
        return (
            self._least, self._most, len(self._first), self._sums, self._logs, self._tables,
            self._starts,
        )  # fmt: skip

    def learn(self, index: np.ndarray, target: np.ndarray) -> None:
        """Learns probabilities that reduce the second moment of the estimate. It is minimal if each
        technique's part of the second moment, divided by its probability, is the same.

        Parameters:
            index: The technique of each of many independent paths.
            target: The target function of each path divided by its density.
        """
        moments = np.bincount(index, target.astype(np.float64) ** 2, minlength=len(self._first))
        found = np.sqrt(moments * self._chance)
        if found.sum() > 0:
            self._set(_FLOOR * self._first + (1 - _FLOOR) * found / found.sum())

    def choose(self, sample: mi.Float) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """Chooses a technique: its index, the length, and the number of vertices made from the
        camera."""
        last = len(self._first) - 1
        index = first_above(
            self._sums, mi.UInt32(0), mi.UInt32(last), sample * ONE_MINUS_EPSILON, mi.Bool(True),
            last + 1,
        )  # fmt: skip
        return index, *(dr.gather(mi.UInt32, table, index) for table in self._tables)

    def log_chance(self, length: mi.UInt32, grown: mi.UInt32, active: mi.Bool) -> mi.Float:
        """The logarithm of the probability of a technique."""
        active = active & (length >= self._least) & (length <= self._most) & (grown <= length)
        start = dr.gather(mi.UInt32, self._starts, length, active)
        return dr.gather(mi.Float, self._logs, start + grown, active)
