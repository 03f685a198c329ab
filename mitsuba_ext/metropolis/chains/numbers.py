"""The numbers of chains. Each stands in for a sampler (``transport/numbers.py``)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .small_steps import SmallSteps


def stream(seed: int, number: int) -> int:
    """The seed of one of the streams of random numbers that a render needs."""
    return int(mi.sample_tea_32(mi.UInt32(seed), number)[0][0])


def generator(seed: int, sequence: mi.UInt32) -> mi.PCG32:
    """A generator of random numbers in each lane; ``sequence`` tells those of a seed apart."""
    # As Mitsuba's samplers: neighbouring sequences of PCG32 itself are correlated
    state, stream = mi.sample_tea_32(dr.opaque(mi.UInt32, seed), sequence)
    # A size would add the number of the lane
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))


class StateNumbers:
    """The numbers of a chain's state: here, none. No dataclass: loops of the estimator only read
    it.

    Parameters:
        steps: How numbers are moved.
    """

    def __init__(self, steps: SmallSteps) -> None:
        self.steps = steps

    def read(self, index: mi.UInt32) -> mi.Float:
        """A number of the state."""
        return mi.Float(0)

    def write(self, index: mi.UInt32, value: mi.Float) -> None:
        """Is told what is drawn."""


class LocalNumbers(StateNumbers):
    """Numbers in memory of the lane."""

    def __init__(self, values: dr.Local, steps: SmallSteps) -> None:
        super().__init__(steps)
        self._values = values

    def read(self, index):
        return self._values[index]


class RecordedNumbers(StateNumbers):
    """Numbers in global memory, from one array into another.

    Parameters:
        values: Of all states: all first numbers, then all second ones, and so on.
        lanes: How many states there are.
    """

    def __init__(self, values: mi.Float, lanes: int, steps: SmallSteps) -> None:
        super().__init__(steps)
        self._values, self._lanes = values, dr.opaque(mi.UInt32, lanes)
        self._count = dr.opaque(mi.UInt32, len(values) // lanes)
        self._lane = dr.arange(mi.UInt32, lanes)
        #: What was told; numbers that were not stay 0.
        self.written = dr.zeros(mi.Float, len(values))

    def read(self, index):
        return dr.gather(mi.Float, self._values, index * self._lanes + self._lane)

    def write(self, index, value):
        place = index * self._lanes + self._lane
        dr.scatter(self.written, value, place, index < self._count)


@dataclass
class StratifiedNumbers:
    """Independent numbers, the first two of which lie in a cell of a grid over the unit square:
    they are the place on the film.

    Attributes:
        rng: Where they come from.
        index: How many were drawn.
        corner: Of the cell, in units of cells.
        cells: Cells of the grid in each direction.
        record: Is told what is drawn.
    """

    rng: mi.PCG32
    index: mi.UInt32
    corner: mi.Point2f
    cells: mi.Float
    record: StateNumbers

    @classmethod
    def begin(
        cls, rng: mi.PCG32, cell: mi.UInt32, cells: int, record: StateNumbers
    ) -> StratifiedNumbers:
        """Before the first number. ``cell`` is the number of the cell, row by row."""
        side = dr.opaque(mi.UInt32, cells)
        corner = mi.Point2f(mi.Float(cell % side), mi.Float(cell // side))
        return cls(rng, dr.zeros(mi.UInt32, dr.width(cell)), corner, mi.Float(side), record)

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        x = self.rng.next_float32()
        corner = dr.select(self.index == 0, self.corner.x, self.corner.y)
        in_cell = dr.minimum((corner + x) / self.cells, 1 - 2.0**-24)
        x = dr.select(self.index < 2, in_cell, x)
        self.record.write(self.index, x)
        self.index = self.index + 1
        return x

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        x = self.next_1d(active)
        return mi.Point2f(x, self.next_1d(active))


@dataclass
class ProposedNumbers:
    """The numbers of a proposal: those of the state, moved, and new ones after them.

    Those that the state's path did not draw have no influence on it, so that a proposal that needs
    more draws them anew: the move has the density 1 in both directions.

    Attributes:
        rng: Where new numbers and moves come from: one number for each.
        index: How many were drawn.
        known: How many of the state's numbers are moved; 0 in a large step.
        state: The state's numbers.
    """

    rng: mi.PCG32
    index: mi.UInt32
    known: mi.UInt32
    state: StateNumbers

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        x = self.rng.next_float32()
        is_known = self.index < self.known
        value = self.state.read(dr.select(is_known, self.index, 0))
        x = dr.select(is_known, self.state.steps.move(value, x), x)
        self.state.write(self.index, x)
        self.index = self.index + 1
        return x

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        x = self.next_1d(active)
        return mi.Point2f(x, self.next_1d(active))
