"""The automaton of light path expressions as tables for kernels.

Kernels look up one word for all kinds of lobes: a *column* is what happens at a vertex except for
the lobe, and the word of a state and a column has the next state for each kind.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..scene.expressions.alphabet import PER_CLASS, STRAIGHT, VOLUME
from ..scene.expressions.automaton import MOST_STATES, Automaton
from ..util.arrays import from_numpy

#: The kinds of lobes, in the order of the alphabet's symbols, and their number.
DIFFUSE, GLOSSY, SPECULAR, KINDS = 0, 1, 2, 3

#: The columns of a class of surfaces: ``R`` and ``T``, and two that do not depend on the surface.
TRANSMITS, SCATTERS, PASSES, COLUMNS = 1, 2, 3, 4

#: The bits of a state and of a cell in a word.
_STATE_BITS, _CELL_BITS = 10, 16
assert MOST_STATES <= 1 << _STATE_BITS

#: The most words of the table of connections.
_MOST_WORDS = 1 << 24


# Not a dataclass: Dr.Jit would treat a dataclass used in a loop as part of the loop's state
class EventTables:
    """The tables of an automaton. All methods take a list of states, for one path.

    Attributes:
        steps, back: The words of the forward automaton, and of the backward one.
        reads, reads_back: Whether these have more than one state.
        begins: The state of the backward automaton behind each class of lights.
        light_class: For each class of lights of the automaton, the class here.
        tell_lobes_apart: Whether any state depends on whether a lobe is diffuse or glossy.

    Raises:
        ValueError: The expressions are too complex.
    """

    def __init__(self, automaton: Automaton) -> None:
        steps, back = (_by_kind(table) for table in (automaton.next, automaton.back))
        # Lights that no expression tells apart are one
        ends = np.concatenate([automaton.ends, automaton.begins[None]])
        ends, light_class = np.unique(ends, axis=1, return_inverse=True)
        ends, begins = ends[:-1], ends[-1]
        self.light_class = light_class.reshape(-1)
        self._columns, self._lights = steps.shape[1], ends.shape[1]
        self.steps, self.back = (
            _packed(np.moveaxis(table, 2, 0), _STATE_BITS) for table in (steps, back)
        )
        if steps[..., 0].size * self._lights > _MOST_WORDS or len(automaton.cells) >> _CELL_BITS:
            raise ValueError(
                "the light path expressions need too large a table: render fewer expressions at "
                "once, or name fewer lights and surfaces in them"
            )
        lit = ends[steps[..., :SPECULAR]]
        self._lit = _packed(np.moveaxis(lit, 2, 0), _CELL_BITS)
        self._ends, self.begins = (from_numpy(mi.UInt32, table) for table in (ends, begins))
        self._pairs, self._backs = from_numpy(mi.UInt32, automaton.pairs), len(back)
        self.reads, self.reads_back = len(steps) > 1, len(back) > 1
        self.tell_lobes_apart = any(
            bool((table[..., DIFFUSE] != table[..., GLOSSY]).any()) for table in (steps, back)
        )

    def words(
        self, table: mi.UInt32, states: list[mi.UInt32], column: mi.UInt32
    ) -> list[mi.UInt32]:
        """The words of a ``table``: :attr:`steps` or :attr:`back`."""
        return [dr.gather(mi.UInt32, table, s * self._columns + column) for s in states]

    def ended(self, states: list[mi.UInt32], light: mi.UInt32) -> list[mi.UInt32]:
        """The cells of paths that end at a light of the class ``light``."""
        return [dr.gather(mi.UInt32, self._ends, s * self._lights + light) for s in states]

    def lit(
        self, states: list[mi.UInt32], column: mi.UInt32, light: mi.UInt32
    ) -> tuple[list[mi.UInt32], list[mi.UInt32]]:
        """The cells of paths whose last vertex has the ``column``, and is connected to a light: if
        its lobe is diffuse, and if it is glossy."""
        words = [
            dr.gather(mi.UInt32, self._lit, (s * self._columns + column) * self._lights + light)
            for s in states
        ]
        mask = (1 << _CELL_BITS) - 1
        return [word & mask for word in words], [word >> _CELL_BITS for word in words]

    def met(self, states: list[mi.UInt32], others: list[mi.UInt32]) -> list[mi.UInt32]:
        """The cells of paths that are joined from two subpaths."""
        return [
            dr.gather(mi.UInt32, self._pairs, state * self._backs + other)
            for state, other in zip(states, others)
        ]


def depends_on_lobe(words: list[mi.UInt32]) -> mi.Bool:
    """Whether the next state depends on whether the lobe is diffuse."""
    mask = (1 << _STATE_BITS) - 1
    return any_of(((word ^ (word >> _STATE_BITS)) & mask) != 0 for word in words)


def states_in(words: list[mi.UInt32], kinds: list[mi.UInt32]) -> list[mi.UInt32]:
    """The states in words, for the kind of lobe of each colour. All colours can share a kind."""
    kinds = kinds * len(words) if len(kinds) < len(words) else kinds
    mask = (1 << _STATE_BITS) - 1
    return [(word >> (kind * _STATE_BITS)) & mask for word, kind in zip(words, kinds)]


def any_of(masks: Iterable[mi.Bool]) -> mi.Bool:
    """Whether any of the masks is true."""
    return functools.reduce(operator.or_, masks)


def _by_kind(steps: np.ndarray) -> np.ndarray:
    """The table of an automaton, shape [states, symbols], as [states, columns, kinds]."""
    steps = steps.reshape(len(steps), -1, PER_CLASS)
    columns = [steps[..., side : side + KINDS] for side in (0, KINDS)]
    columns += [steps[..., [symbol] * KINDS] for symbol in (VOLUME, STRAIGHT)]
    return np.stack(columns, axis=2).reshape(len(steps), -1, KINDS)


def _packed(parts: np.ndarray, bits: int) -> mi.UInt32:
    """Words with one number of each of the ``parts``."""
    words = np.zeros(parts.shape[1:], np.uint32)
    for index, part in enumerate(parts):
        words |= part.astype(np.uint32) << np.uint32(index * bits)
    return from_numpy(mi.UInt32, words)
