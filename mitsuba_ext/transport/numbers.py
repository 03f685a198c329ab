"""The sources of an estimator's random numbers, besides Mitsuba's samplers.

An estimator draws with ``next_1d`` and ``next_2d``. Replacements of a sampler are dataclasses, so
that Dr.Jit's loops see and update how far they have drawn.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

#: With 4, Mitsuba's default, the first numbers of consecutive indices depend on each other.
_ROUNDS = 6


def hashed_2d(word: mi.UInt32, index: mi.UInt32) -> mi.Point2f:
    """Two numbers in [0, 1) for any two integers, by a hash of these.

    Both come from one block of the cipher. The pair of ``mi.sample_tea_float32(word, 2 * index)``
    and ``mi.sample_tea_float32(word, 2 * index + 1)`` is not uniform.

    Source: F. Zafar, M. Olano, A. Curtis, *GPU Random Numbers via the Tiny Encryption Algorithm*,
    High Performance Graphics, 2010.
    """
    x, y = mi.sample_tea_32(word, index, _ROUNDS)
    # A float has 24 significant bits
    return mi.Point2f(x >> 8, y >> 8) * 2.0**-24


def hashed(word: mi.UInt32, count: int) -> list[mi.Float]:
    """``count`` numbers in [0, 1) for any integer: the pairs of :func:`hashed_2d`, one after the
    other."""
    pairs = (hashed_2d(word, mi.UInt32(index)) for index in range((count + 1) // 2))
    return [x for pair in pairs for x in pair][:count]


class Numbers(Protocol):
    """The methods of a sampler that an estimator calls."""

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        """The next number in [0, 1)."""

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        """The next two."""


@dataclass
class HashedNumbers:
    """Numbers by a hash.

    Attributes:
        word: Chooses the sequence of a lane.
        index: How many numbers it has drawn.
    """

    word: mi.UInt32
    index: mi.UInt32

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        return self.next_2d(active).x

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        self.index = self.index + 1
        return hashed_2d(self.word, self.index)


@dataclass
class BothEnds:
    """Numbers of a bidirectional path, one sequence for each subpath: the numbers of the camera
    subpath do not depend on how many the light subpath draws.

    Attributes:
        camera, light: The numbers of each subpath.
    """

    camera: Numbers
    light: Numbers

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        return self.camera.next_1d(active)

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        return self.camera.next_2d(active)


def schedule_state(numbers: Numbers) -> None:
    """Schedules the position that ``numbers`` have reached for the next evaluation: it would be
    traced again otherwise."""
    if isinstance(numbers, mi.Sampler):
        numbers.schedule_state()
    else:
        dr.schedule(numbers)


def copied(numbers: Numbers) -> Numbers:
    """A copy of ``numbers``: drawing from it does not change them. A sampler is not copied."""
    if isinstance(numbers, mi.Sampler):
        return numbers
    if isinstance(numbers, BothEnds):
        return BothEnds(copied(numbers.camera), copied(numbers.light))
    result = copy.copy(numbers)
    for key, value in _arrays(numbers).items():
        setattr(result, key, type(value)(value))
    return result


def reached(numbers: Numbers) -> Any:
    """The position that ``numbers`` have reached, for a frozen function to return; ``None`` for a
    sampler, which keeps its own."""
    if isinstance(numbers, mi.Sampler):
        return None
    if isinstance(numbers, BothEnds):
        return reached(numbers.camera), reached(numbers.light)
    return _arrays(numbers)


def go_to(numbers: Numbers, place: Any) -> None:
    """Moves ``numbers`` to the position that a frozen function has reached with copies of them."""
    if isinstance(numbers, BothEnds):
        go_to(numbers.camera, place[0])
        go_to(numbers.light, place[1])
    elif not isinstance(numbers, mi.Sampler):
        vars(numbers).update(place)


def _arrays(numbers: Numbers) -> dict[str, Any]:
    """The attributes that drawing changes; others, such as a record of what was drawn, stay."""
    return {
        key: value for key, value in vars(numbers).items()
        if dr.is_array_v(value) or hasattr(type(value), "DRJIT_STRUCT")
    }  # fmt: skip


# Not a dataclass: loops only read it, and it does not have the width of their state
class NumberTable:
    """A vector of numbers for each lane.

    Parameters (and attributes):
        values: Numbers in [0, 1): all first numbers, then all second ones, and so on.
        lanes: Number of lanes.
    """

    def __init__(self, values: mi.Float, lanes: int) -> None:
        self.values, self.lanes = values, dr.opaque(mi.UInt32, lanes)
        self.count = dr.opaque(mi.UInt32, len(values) // lanes)


@dataclass
class StoredNumbers:
    """Numbers from a stored vector, for replay: lane i draws the numbers of lane i of the table.

    Attributes:
        table: The numbers. After the last one, all are 0: a path that draws more numbers than are
            stored is not the stored path.
        lane: Which vector a lane draws from.
        index: How many numbers a lane has drawn.
    """

    table: NumberTable
    lane: mi.UInt32
    index: mi.UInt32

    @classmethod
    def begin(cls, table: NumberTable, lanes: int) -> StoredNumbers:
        """Before the first number of the first ``lanes`` vectors."""
        return cls(table, dr.arange(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes))

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        known = active & (self.index < self.table.count)
        entry = self.index * self.table.lanes + self.lane
        self.index = self.index + 1
        return dr.gather(mi.Float, self.table.values, entry, known)

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        x = self.next_1d(active)
        return mi.Point2f(x, self.next_1d(active))
