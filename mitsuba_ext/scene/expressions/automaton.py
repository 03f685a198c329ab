"""Automata that recognize light path expressions.

All expressions together become one nondeterministic automaton (Thompson 1968). The subset
construction makes two deterministic ones of it. The *forward* automaton reads a path from the
camera to the light. The *backward* automaton reads it from the light. A path that is joined from
two subpaths is known by a pair of states: the forward states that the camera's part can reach, and
the backward states from which the light's part is accepted. It belongs to an expression if they
have a state of that expression in common.

Contributions are not added to expressions, but to *cells*: the parts into which the expressions
divide all paths. A cell is the set of expressions to which a path belongs, so that each
contribution is added once, however many expressions there are.

Source: J. E. Hopcroft, J. D. Ullman, *Introduction to Automata Theory, Languages, and Computation*,
1979, sections 2.3 to 2.5; E. F. Moore, *Gedanken-experiments on Sequential Machines*, 1956 (the
minimal automaton).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from .notation import Alternatives, Expression, OneOf, Repetition, Symbol, Tree
from .notation import Sequence as InSequence

#: The largest number of states of a deterministic automaton.
MOST_STATES = 1 << 10


class TooManyStatesError(ValueError):
    """The expressions need too many states."""

    def __init__(self) -> None:
        super().__init__(
            f"the light path expressions need an automaton of more than {MOST_STATES} states: "
            f"repeat less often with braces, or render fewer expressions at once"
        )


@dataclass
class _Nondeterministic:
    """The automaton of all expressions.

    Attributes:
        steps: For each state, the states that it reaches with each set of symbols.
        silent: For each state, the states that it reaches without a symbol.
        owner: The number of the expression to which each state belongs.
        last: The accepting state of each expression.
    """

    steps: list[list[tuple[OneOf, int]]] = field(default_factory=list)
    silent: list[list[int]] = field(default_factory=list)
    owner: list[int] = field(default_factory=list)
    last: list[int] = field(default_factory=list)

    def add(self, expression: Expression) -> int:
        """Adds an expression. Returns its first state."""
        number = len(self.last)
        first = self._state(number)
        self.last.append(self._append(expression.tree, first, number))
        return first

    def _state(self, owner: int) -> int:
        self.steps.append([])
        self.silent.append([])
        self.owner.append(owner)
        return len(self.owner) - 1

    def _append(self, tree: Tree, begin: int, owner: int) -> int:
        """Appends what ``tree`` accepts to the state ``begin``. Returns the state behind it."""
        if isinstance(tree, OneOf):
            end = self._state(owner)
            self.steps[begin].append((tree, end))
        elif isinstance(tree, InSequence):
            end = begin
            for part in tree.parts:
                end = self._append(part, end, owner)
        elif isinstance(tree, Alternatives):
            end = self._state(owner)
            for part in tree.parts:
                self._link(self._append(part, self._after(begin, owner), owner), end)
        else:
            end = self._repeat(tree, begin, owner)
        return end

    def _repeat(self, tree: Repetition, begin: int, owner: int) -> int:
        for _ in range(tree.least):
            begin = self._append(tree.part, begin, owner)
        if tree.most is None:
            again = self._after(begin, owner)
            self._link(self._append(tree.part, again, owner), again)
            return self._after(again, owner)
        end = self._state(owner)
        self._link(begin, end)
        for _ in range(tree.least, tree.most):
            begin = self._append(tree.part, self._after(begin, owner), owner)
            self._link(begin, end)
        return end

    def _after(self, state: int, owner: int) -> int:
        """A new state that ``state`` reaches without a symbol."""
        new = self._state(owner)
        self._link(state, new)
        return new

    def _link(self, one: int, other: int) -> None:
        self.silent[one].append(other)


States = frozenset  # of the nondeterministic automaton


@dataclass
class Automaton:
    """The deterministic automata of some expressions, for the symbols of a scene.

    Attributes:
        next: The forward state after a state and a symbol of a vertex;
            shape [forward states, symbols]. Paths begin in state 0, behind the camera.
        ends: The cell of a path in a state at a light; shape [forward states, lights].
        begins: The backward state behind each light; shape [lights].
        back: The backward state after a state and a symbol of a vertex;
            shape [backward states, symbols].
        pairs: The cell of a path that is joined from two subpaths;
            shape [forward states, backward states].
        cells: The expressions of each cell, by number. Cell 0 has none: its paths are not needed.
    """

    next: np.ndarray
    ends: np.ndarray
    begins: np.ndarray
    back: np.ndarray
    pairs: np.ndarray
    cells: list[frozenset[int]]

    @classmethod
    def of(
        cls, expressions: Sequence[Expression], vertices: Sequence[Symbol], lights: Sequence[Symbol]
    ) -> Automaton:
        """The automata of ``expressions``, for these symbols.

        Raises:
            TooManyStatesError: They would have more than ``MOST_STATES`` states.
        """
        nfa = _Nondeterministic()
        firsts = [nfa.add(expression) for expression in expressions]
        forward = _Stepper(nfa, expressions, is_forward=True)
        backward = _Stepper(nfa, expressions, is_forward=False)
        camera = forward.step(forward.closed(firsts), Symbol("C"))
        ahead, next_ = _explored([camera], vertices, forward.step)
        ends = [backward.step(backward.closed(nfa.last), light) for light in lights]
        behind, back = _explored(ends, vertices, backward.step)

        def met(one: States, other: States) -> frozenset[int]:
            return frozenset(nfa.owner[state] for state in one & other)

        pairs = [[met(one, other) for other in behind] for one in ahead]
        cells = [frozenset(), *sorted({x for row in pairs for x in row if x}, key=sorted)]
        number = {cell: index for index, cell in enumerate(cells)}
        table = np.array([[number[x] for x in row] for row in pairs], np.uint32)
        # States with the same future are one: rows and columns of the pairs tell them apart
        ahead_class, next_, table = _minimal(next_, table.reshape(len(ahead), len(behind)))
        behind_class, back, columns = _minimal(back, table.T)
        begins = behind_class[: len(lights)]
        assert ahead_class[0] == 0
        pairs = np.ascontiguousarray(columns.T)
        return cls(next_, pairs[:, begins], begins, back, pairs, cells)

    @property
    def state_count(self) -> int:
        """Number of forward states."""
        return len(self.next)

    def tells_apart(self, one: int, other: int) -> bool:
        """Whether it matters which of two symbols a vertex has."""
        return any(
            bool((table[:, one] != table[:, other]).any()) for table in (self.next, self.back)
        )

    def where_apart(self, one: int, other: int) -> np.ndarray:
        """The forward states in which it matters which of two symbols comes next."""
        return self.next[:, one] != self.next[:, other]

    @property
    def has_states(self) -> bool:
        """Whether it matters at all what happens at vertices."""
        return len(self.next) > 1 or len(self.back) > len(set(self.begins.tolist()))


class _Stepper:
    """Steps from one set of states of the nondeterministic automaton to the next.

    Parameters:
        is_forward: Whether it steps from the camera to the light.
    """

    def __init__(
        self, nfa: _Nondeterministic, expressions: Sequence[Expression], is_forward: bool
    ) -> None:
        self._sees_straight = [expressions[owner].sees_straight for owner in nfa.owner]
        if is_forward:
            self._steps, self._silent = nfa.steps, nfa.silent
            return
        self._steps = [[] for _ in nfa.steps]
        self._silent = [[] for _ in nfa.silent]
        for state, steps in enumerate(nfa.steps):
            for symbols, reached in steps:
                self._steps[reached].append((symbols, state))
            for reached in nfa.silent[state]:
                self._silent[reached].append(state)

    def closed(self, states: Sequence[int]) -> States:
        """``states``, and what they reach without a symbol."""
        found, left = set(states), list(states)
        while left:
            for reached in self._silent[left.pop()]:
                if reached not in found:
                    found.add(reached)
                    left.append(reached)
        return States(found)

    def step(self, states: States, symbol: Symbol) -> States:
        """The states behind ``symbol``."""
        reached = set()
        for state in states:
            if symbol.is_straight and not self._sees_straight[state]:
                reached.add(state)
            else:
                reached |= {end for symbols, end in self._steps[state] if symbol in symbols}
        return self.closed(sorted(reached))


def _explored(
    begins: Sequence[States],
    symbols: Sequence[Symbol],
    step: Callable[[States, Symbol], States],
) -> tuple[list[States], np.ndarray]:
    """All sets of states that can be reached from ``begins``, which come first, and the table of
    their steps."""
    found = list(begins)
    number: dict[States, int] = {}
    for index, states in enumerate(found):
        number.setdefault(states, index)
    rows: list[list[int]] = []
    while len(rows) < len(found):
        row = []
        for symbol in symbols:
            states = step(found[len(rows)], symbol)
            if states not in number:
                number[states] = len(found)
                found.append(states)
                if len(found) > MOST_STATES:
                    raise TooManyStatesError()
            row.append(number[states])
        rows.append(row)
    return found, np.array(rows, np.uint32).reshape(len(found), len(symbols))


def _minimal(steps: np.ndarray, results: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joins states that have the same ``results``, and so have all states that they reach.

    Parameters:
        steps: Shape [states, symbols].
        results: Shape [states, any].

    Returns:
        The class of each state, and ``steps`` and ``results`` of the classes. The classes are in
        the order of their first states.
    """
    classes = _classes(results)
    while True:
        finer = _classes(np.concatenate([classes[:, None], classes[steps]], axis=1))
        if finer.max(initial=0) == classes.max(initial=0):
            break
        classes = finer
    first = [int(np.argmax(classes == k)) for k in range(int(classes.max(initial=0)) + 1)]
    return classes, classes[steps[first]].astype(np.uint32), results[first]


def _classes(rows: np.ndarray) -> np.ndarray:
    """The number of each row among the distinct ones, in the order in which they first occur."""
    known: dict[bytes, int] = {}
    keys = [row.tobytes() for row in np.ascontiguousarray(rows)]
    return np.array([known.setdefault(key, len(known)) for key in keys], np.uint32)
