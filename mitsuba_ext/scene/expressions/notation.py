"""The notation of light path expressions, which is the notation of OSL.

A path is a word. It begins with the camera ``C``, has one event for each vertex at which it
scatters, in the order from the camera to the light, and ends with the event of the light. An event
has a *type*, a *scattering* and *labels*:

- The type is ``R`` (reflection), ``T`` (transmission) or ``V`` (volume) at a vertex, and ``L`` at a
  light. The light of a shape is also ``O`` (object), the light of an environment also ``B``
  (background).
- The scattering is ``D`` (diffuse), ``G`` (glossy), ``S`` (specular: a mirror, smooth glass) or
  ``s`` (straight: through an opacity mask, an index-matched surface or a thin pane).
- Labels are the names of lights, shapes and BSDFs.

Source: Open Shading Language, ``src/liboslexec/lpeparse.cpp`` and ``lpexp.h``; P. S. Heckbert,
*Adaptive Radiosity Textures for Bidirectional Ray Tracing*, SIGGRAPH 1990 (the letters).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Union

#: The letters of types, and of scatterings.
TYPES, SCATTERINGS = "CRTVLOB", "DGSs"

#: The largest number of repetitions that braces can ask for.
MOST_REPETITIONS = 32


@dataclass(frozen=True)
class Symbol:
    """What can happen at a vertex of a path.

    Attributes:
        types: The letters of its type: one, or two at lights.
        scattering: The letter of its scattering; empty in volumes, at lights and at the camera.
        labels: The names of the light, or of the shape and its BSDF.
    """

    types: str
    scattering: str = ""
    labels: frozenset[str] = frozenset()

    @property
    def is_straight(self) -> bool:
        """Whether light passes without being scattered."""
        return self.scattering == "s"


@dataclass(frozen=True)
class Event:
    """A set of symbols: those that have all of the given properties.

    Attributes:
        types, scatterings: The letters that a symbol may have; ``None`` for any.
        labels: The labels that it must have.
    """

    types: str | None = None
    scatterings: str | None = None
    labels: tuple[str, ...] = ()

    def __contains__(self, symbol: Symbol) -> bool:
        return (
            (self.types is None or bool(set(self.types) & set(symbol.types)))
            and (self.scatterings is None or symbol.scattering in list(self.scatterings))
            and set(self.labels) <= symbol.labels
        )


@dataclass(frozen=True)
class OneOf:
    """A set of symbols: all that one of the events contains, or with ``negated`` all others."""

    events: tuple[Event, ...]
    negated: bool = False

    def __contains__(self, symbol: Symbol) -> bool:
        return any(symbol in event for event in self.events) != self.negated


@dataclass(frozen=True)
class Sequence:
    """One expression after the other."""

    parts: tuple[Tree, ...]


@dataclass(frozen=True)
class Alternatives:
    """Any of these expressions."""

    parts: tuple[Tree, ...]


@dataclass(frozen=True)
class Repetition:
    """An expression, ``least`` to ``most`` times; ``most`` is ``None`` for any number."""

    part: Tree
    least: int
    most: int | None


#: A node of the syntax tree.
Tree = Union[OneOf, Sequence, Alternatives, Repetition]


class ExpressionError(ValueError):
    """A syntax error in an expression. The message gives its position, and shows it."""


@dataclass(frozen=True)
class Expression:
    """A light path expression.

    Attributes:
        text: As it was written.
        tree: What it means.
        labels: The labels that occur in it.
        sees_straight: Whether ``s`` occurs in it. If not, events at which light passes straight
            through a surface are passed over, as if the surface were not there.
    """

    text: str
    tree: Tree
    labels: frozenset[str]
    sees_straight: bool

    @classmethod
    def parse(cls, text: str) -> Expression:
        """Reads an expression.

        Raises:
            ExpressionError: ``text`` is not an expression.
        """
        parser = _Parser(text)
        tree = parser.whole()
        return cls(text, tree, frozenset(parser.labels), parser.sees_straight)


class _Parser:
    """A parser by recursive descent."""

    def __init__(self, text: str) -> None:
        self._text, self._place = text, 0
        self.labels: set[str] = set()
        self.sees_straight = False

    def whole(self) -> Tree:
        tree = self._alternatives()
        if self._place < len(self._text):
            raise self._error(f'unexpected "{self._next}"')
        return tree

    # ---- Expressions ----

    def _alternatives(self) -> Tree:
        parts = [self._sequence()]
        while self._skip("|"):
            parts.append(self._sequence())
        return parts[0] if len(parts) == 1 else Alternatives(tuple(parts))

    def _sequence(self) -> Tree:
        parts = []
        while self._next and self._next not in "|)":
            parts.append(self._repeated())
        if not parts:
            raise self._error("an event is missing")
        return parts[0] if len(parts) == 1 else Sequence(tuple(parts))

    def _repeated(self) -> Tree:
        tree = self._atom()
        while self._next and self._next in "*+?{":
            if self._skip("*"):
                tree = Repetition(tree, 0, None)
            elif self._skip("+"):
                tree = Repetition(tree, 1, None)
            elif self._skip("?"):
                tree = Repetition(tree, 0, 1)
            else:
                tree = Repetition(tree, *self._counts())
        return tree

    def _counts(self) -> tuple[int, int | None]:
        """``{n}``, ``{n,}`` or ``{n,m}``."""
        start = self._place
        self._expect("{")
        least = most = self._count()
        if self._skip(","):
            most = None if self._next == "}" else self._count()
        self._expect("}")
        if most is not None and most < least:
            self._place = start
            raise self._error("the largest number of repetitions is less than the smallest")
        return least, most

    def _count(self) -> int:
        start = self._place
        while self._next in set("0123456789"):
            self._place += 1
        digits = self._text[start : self._place]
        if not digits or int(digits) > MOST_REPETITIONS:
            self._place = start
            raise self._error(f"a number from 0 to {MOST_REPETITIONS} is expected")
        return int(digits)

    def _atom(self) -> Tree:
        if self._skip("("):
            tree = self._alternatives()
            self._expect(")")
            return tree
        if self._next == "[":
            return self._set()
        return OneOf((self._event(),))

    # ---- Events ----

    def _set(self) -> OneOf:
        self._expect("[")
        negated, events = self._skip("^"), []
        while self._next and self._next != "]":
            events.append(self._event())
        if not events:
            raise self._error("an event is missing")
        self._expect("]")
        return OneOf(tuple(events), negated)

    def _event(self) -> Event:
        """A letter, a point, a label, or a group such as ``<RD>``."""
        letter = self._next
        if letter == "<":
            return self._group()
        if letter == "'":
            return Event(labels=(self._label(),))
        if letter and letter in TYPES:
            self._place += 1
            return Event(types=letter)
        if letter and letter in SCATTERINGS:
            return Event(scatterings=self._letters(SCATTERINGS))
        if self._skip("."):
            return Event()
        found = f'found "{letter}"' if letter else "the expression ends"
        raise self._error(
            f"an event is expected: one of {' '.join(TYPES + SCATTERINGS)}, a point, a label in "
            f"single quotes, or <…>, […], (…); {found}"
        )

    def _group(self) -> Event:
        """``<`` type, scattering, labels ``>``; all but the type can be left out."""
        self._expect("<")
        types = self._letters(TYPES)
        scatterings = None
        if self._next not in ("", ">", "'"):
            scatterings = self._letters(SCATTERINGS)
        labels = []
        while self._next == "'":
            labels.append(self._label())
        self._expect(">")
        return Event(types, scatterings, tuple(labels))

    def _letters(self, known: str) -> str | None:
        """One of the ``known`` letters, a set of them in brackets, or a point for any."""
        if self._skip("."):
            return None
        if self._skip("["):
            negated, letters = self._skip("^"), ""
            while self._next and self._next != "]":
                letters += self._letter(known)
            self._expect("]")
            chosen = [x for x in known if (x in letters) != negated]
            self.sees_straight |= "s" in letters
            return "".join(chosen)
        letter = self._letter(known)
        self.sees_straight |= letter == "s"
        return letter

    def _letter(self, known: str) -> str:
        letter = self._next
        if not letter or letter not in known:
            raise self._error(f"one of {' '.join(known)} or a point is expected")
        self._place += 1
        return letter

    def _label(self) -> str:
        start = self._place
        end = self._text.find("'", start + 1)
        if end < start + 2:
            raise self._error("a label needs a name and two single quotes, as in 'key'")
        self._place = end + 1
        label = self._text[start + 1 : end]
        self.labels.add(label)
        return label

    # ---- Characters ----

    @property
    def _next(self) -> str:
        """The next character; empty at the end."""
        return self._text[self._place : self._place + 1]

    def _skip(self, character: str) -> bool:
        if self._next != character:
            return False
        self._place += 1
        return True

    def _expect(self, character: str) -> None:
        if not self._skip(character):
            raise self._error(f'"{character}" is expected')

    def _error(self, message: str) -> ExpressionError:
        before, after = self._text[: self._place], self._text[self._place :]
        return ExpressionError(
            f'"{self._text}" is no light path expression: at character {self._place + 1} '
            f"({before}▸{after}), {message}"
        )
