"""Errors that the command line shows as one sentence, without a traceback."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

#: The text before the traceback in Mitsuba's message for an error in a plugin written in Python.
_TRACEBACK = "Traceback (most recent call last):\n"


class InputError(ValueError):
    """An input of the user cannot be used. The message is one line that names it and the fault."""


class InstallationError(RuntimeError):
    """Installed software cannot be used. The message says what to do."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``': did you mean "neepp"?'``, or nothing if no known name resembles ``name``."""
    close = difflib.get_close_matches(name.lower(), known, n=1)
    return f': did you mean "{close[0]}"?' if close else ""


def one_line(error: BaseException | str) -> str:
    """A message of Mitsuba without source positions ("[parser.cpp:12] ", "[PLYMesh] ") and line
    breaks. For an error in a plugin that is written in Python, Mitsuba quotes the whole traceback;
    only the message at its end is kept. For an error in a traced function, Dr.Jit only says "see
    above"; the message of its cause is returned."""
    while "(see above)" in str(error) and isinstance(error, BaseException):
        cause = error.__cause__ or error.__context__
        if cause is None:
            break
        error = cause
    text = str(error)
    if _TRACEBACK in text:
        before, *_, last = text.split(_TRACEBACK)
        # The frames are indented; what follows is "ValueError: message"
        kind, _colon, message = re.sub(r"\A(?: .*\n)*", "", last).partition(": ")
        text = before + (message or kind)
    text = re.sub(r"\[\w+(?:\.(?:cpp|h):\d+)?\] ", "", text)
    # A nested object is printed with all its parameters
    text = re.sub(r'(- object "\w+": \w+)\[.*\]', r"\1", text, flags=re.S)
    # "Found 1 unreferenced property in …:\n  - float "radiusx": 3"
    return re.sub(r"\s*\n\s*(?:- )?", " ", text).strip() or type(error).__name__
