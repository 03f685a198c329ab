"""Light path expressions: the notation, and the automata that recognize paths."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from mitsuba_ext.scene.aovs import PASSES, Aovs
from mitsuba_ext.scene.expressions.automaton import Automaton, TooManyStatesError
from mitsuba_ext.scene.expressions.notation import Expression, ExpressionError, Symbol

#: Symbols, each with a letter for Python's regular expressions.
VERTICES = [Symbol(t, s) for t in "RT" for s in "DGS"] + [Symbol("V"), Symbol("T", "s")]
LIGHTS = [Symbol("LO", labels=frozenset({"key"})), Symbol("LB"), Symbol("L")]
LETTERS = "abcdefvs"
LIGHT_LETTERS = "xyz"

#: Expressions, and the same over those letters. "s" is ignored unless an expression names it.
EQUAL = [
    ("CL", "[xyz]"),
    ("C.*L", "[a-fv]*[xyz]"),
    ("C<RD>S+.*L", "a[cf]+[a-fv]*[xyz]"),
    ("C.*<L.'key'>", "[a-fv]*x"),
    ("C[^D]*B", "[bcefv]*y"),
    ("C(<RD>|<T[GS]>){1,2}V?O", "(a|[ef]){1,2}v?x"),
    ("C<Ts>*RL", "s*[abc][xyz]"),
    ("C<R[^G]>{2}L|CVL", "([ac]{2}|v)[xyz]"),
    ("C.{2,}'key'", "[a-fv]{2,}x"),
    *((PASSES[name], pattern) for name, pattern in {
        "direct": "[a-fv][xyz]", "indirect": "[a-fv]{2,}[xyz]", "diffuse": "a[a-fv]*[xyz]",
        "glossy": "[bc][a-fv]*[xyz]", "transmission": "[def][a-fv]*[xyz]",
        "volume": "v[a-fv]*[xyz]", "caustics": "[a-fv]*[ad][bcef]+[xyz]",
    }.items()),
]  # fmt: skip


def _words(longest: int = 3):
    for length in range(longest + 1):
        yield from itertools.product(range(len(VERTICES)), repeat=length)


def test_the_automaton_accepts_the_paths_of_its_expressions() -> None:
    expressions = [Expression.parse(text) for text, _ in EQUAL]
    automaton = Automaton.of(expressions, VERTICES, LIGHTS)
    patterns = [
        re.compile(pattern if text == "C<Ts>*RL" else f"(?:{pattern})") for text, pattern in EQUAL
    ]
    for word in _words():
        letters = "".join(LETTERS[symbol] for symbol in word)
        state = 0
        for symbol in word:
            state = automaton.next[state, symbol]
        for light, letter in enumerate(LIGHT_LETTERS):
            found = automaton.cells[automaton.ends[state, light]]
            expected = {
                index for index, pattern in enumerate(patterns)
                if pattern.fullmatch(
                    (letters if expressions[index].sees_straight else letters.replace("s", ""))
                    + letter
                )
            }  # fmt: skip
            assert found == expected, letters + letter


def test_a_path_has_the_same_cell_wherever_it_is_joined() -> None:
    expressions = [Expression.parse(text) for text, _ in EQUAL]
    automaton = Automaton.of(expressions, VERTICES, LIGHTS)
    generator = np.random.default_rng(1)
    for _ in range(300):
        word = generator.integers(len(VERTICES), size=generator.integers(6))
        light = generator.integers(len(LIGHTS))
        ahead, behind = [0], [automaton.begins[light]]
        for symbol in word:
            ahead.append(automaton.next[ahead[-1], symbol])
        for symbol in word[::-1]:
            behind.append(automaton.back[behind[-1], symbol])
        cells = {automaton.pairs[q, r] for q, r in zip(ahead, behind[::-1])}
        assert cells == {automaton.ends[ahead[-1], light]}


def test_an_expression_that_sees_nothing_of_a_path_needs_no_states() -> None:
    automaton = Automaton.of([Expression.parse("C.*<L.'key'>")], VERTICES, LIGHTS)
    assert automaton.next.shape[0] == 1 and len(automaton.cells) == 2


@pytest.mark.parametrize(
    ("text", "place"),
    [("", 1), ("C<RD", 5), ("C.{3,2}L", 3), ("C.*Q", 4), ("C(.L", 5), ("C.*<L.key>", 7),
     ("C'x", 2), ("C.*L)", 5), ("C<X.>L", 3), ("[^]L", 3), ("C.{99}L", 4), ("*", 1), ("C|", 3)],
)  # fmt: skip
def test_a_syntax_error_names_its_place(text: str, place: int) -> None:
    with pytest.raises(ExpressionError, match=f"at character {place} "):
        Expression.parse(text)


def test_expressions_that_need_too_many_states_are_refused() -> None:
    expression = Expression.parse("C.*D.{20}L")
    with pytest.raises(TooManyStatesError, match="states"):
        Automaton.of([expression], VERTICES, LIGHTS)


def test_a_list_holds_expressions_with_commas_and_spaces_in_brackets() -> None:
    aovs = Aovs.read("x", "a:C.{1,2}L, key:C.*<L.'the key'>,d:depth n:sh_normal,g:light_groups")
    assert aovs.by_mitsuba == "d:depth,n:sh_normal" and aovs.groups == ("g",)
    assert [e.text for e in aovs.expressions.values()] == ["C.{1,2}L", "C.*<L.'the key'>"]
    assert list(aovs.of_groups(["key", "sky"])) == ["a", "key", "g.key", "g.sky"]


@pytest.mark.parametrize(
    ("aovs", "message"),
    [
        ("depth", "list of name:type"),
        ("c:caustic", 'did you mean "caustics"'),
        ("c:C<RD", "at character 5"),
        ("c:C<RD>", "no path belongs"),
        ("c:<RD>L", "no path belongs"),
        ("c:CL,c:C.L", 'the name "c"'),
    ],
)
def test_a_wrong_list_is_refused(aovs: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Aovs.read("x", aovs)
