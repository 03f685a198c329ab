"""The random numbers of chains. Each class takes the place of a sampler
(``transport/numbers.py``)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .small_steps import SmallSteps


def stream(seed: int, number: int) -> int:
    """The seed of stream ``number`` of the random numbers of a render."""
    return int(mi.sample_tea_32(mi.UInt32(seed), number)[0][0])


def generator(seed: int, sequence: mi.UInt32) -> mi.PCG32:
    """A random number generator in each lane, for the ``sequence`` with this seed."""
    # Hashed, as in Mitsuba's samplers: neighbouring sequences of PCG32 itself are correlated
    state, stream = mi.sample_tea_32(dr.opaque(mi.UInt32, seed), sequence)
    # Without ``size``, which would add the lane index to the sequence
    return mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))


class StateNumbers:
    """The random numbers of a chain's state; this base class stores none. It is not a dataclass,
    because Dr.Jit would treat one as part of the state of the estimator's loops.

    Parameters:
        steps: The small steps that move numbers.
    """

    def __init__(self, steps: SmallSteps) -> None:
        self.steps = steps

    def read(self, index: mi.UInt32) -> mi.Float:
        """A random number of the state."""
        return mi.Float(0)

    def write(self, index: mi.UInt32, value: mi.Float) -> None:
        """Receives each number drawn."""


class LocalNumbers(StateNumbers):
    """Random numbers in the local memory of the lane."""

    def __init__(self, values: dr.Local, steps: SmallSteps) -> None:
        super().__init__(steps)
        self._values = values

    def read(self, index):
        return self._values[index]


class RecordedNumbers(StateNumbers):
    """Random numbers in global memory, read from one array and written to another one.

    Parameters:
        values: The numbers of all states: all first numbers, then all second numbers, and so on.
        lanes: The number of states.
    """

    def __init__(self, values: mi.Float, lanes: int, steps: SmallSteps) -> None:
        super().__init__(steps)
        self._values, self._lanes = values, dr.opaque(mi.UInt32, lanes)
        self._count = dr.opaque(mi.UInt32, len(values) // lanes)
        self._lane = dr.arange(mi.UInt32, lanes)
        #: The written numbers; 0 for all others.
        self.written = dr.zeros(mi.Float, len(values))

    def read(self, index):
        return dr.gather(mi.Float, self._values, index * self._lanes + self._lane)

    def write(self, index, value):
        place = index * self._lanes + self._lane
        dr.scatter(self.written, value, place, index < self._count)


@dataclass
class StratifiedNumbers:
    """Independent random numbers. The first two are the film position; they lie in a given cell of
    a grid over the unit square.

    Attributes:
        rng: The random number generator.
        index: The number of numbers drawn so far.
        corner: The corner of the cell, in units of cells.
        cells: The number of cells of the grid in each direction.
        record: Receives the numbers drawn.
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
        """The state before the first number. ``cell`` is the index of the cell, row by row."""
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
    """The random numbers of a proposal: the state's numbers, moved by small steps, then new ones.

    Numbers that the state's path did not draw have no influence on it. A proposal that needs more
    numbers draws new ones, with density 1 in both directions.

    Attributes:
        rng: The random number generator, which provides one number for each move or new number.
        index: The number of numbers drawn so far.
        known: The number of the state's numbers that are moved; 0 in a large step.
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
