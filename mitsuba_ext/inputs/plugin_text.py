"""Parses plugins written as text: ``NAME:key=value,key=[NAME:key=value]``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import accumulate
from typing import Any

from ..util.errors import InputError


def parse_plugin(text: str, kind: str = "integrator") -> dict[str, Any]:
    """The plugin that ``text`` describes, as a dict for ``mi.load_dict``.

    - A comma begins a parameter only if ``key=`` follows. Other commas belong to the value,
      which may be a list.
    - A value in square brackets is a nested plugin: text of the same form, to any depth. Its name
      determines its kind.

    >>> parse_plugin("neepp:max_depth=6,hide_emitters=true,aovs=d:depth,a:albedo")
    {'type': 'neepp', 'max_depth': 6, 'hide_emitters': True, 'aovs': 'd:depth,a:albedo'}
    >>> parse_plugin("variance:nested=[path:max_depth=6],batches=8")
    {'type': 'variance', 'nested': {'type': 'path', 'max_depth': 6}, 'batches': 8}

    Args:
        text: The text.
        kind: The kind of plugin, for error messages.

    Raises:
        InputError: The text has the wrong form; the message quotes it.
    """
    try:
        return _parse(text)
    except ValueError as error:
        raise InputError(f'{kind} "{text}": {error}{_meant(text)}') from error


def _meant(text: str) -> str:
    """The correct form of "bdpt,max_depth=4" or "bdpt: max_depth=4"; empty for other texts."""
    likely = re.sub(r"\W+", ":", text.strip(), count=1)
    try:
        _parse(likely)
    except ValueError:
        return ""
    return f': did you mean "{likely}"?'


def _parse(text: str) -> dict[str, Any]:
    name, colon, rest = text.partition(":")
    if not re.fullmatch(r"\w+", name) or (colon and not rest):
        raise ValueError(f'expected NAME or NAME:key=value,key=value, found "{text}"')
    plugin: dict[str, Any] = {"type": name}
    for item in _split(rest):
        key, equals, value = item.partition("=")
        if not (re.fullmatch(r"\w+", key) and equals and value) or value.endswith(","):
            raise ValueError(f'expected key=value, found "{item}"')
        if key in plugin:
            raise ValueError(f'"{key}" is given twice')
        plugin[key] = _parse_value(value)
    return plugin


def _split(text: str) -> Iterator[str]:
    """The texts of the parameters: splits at commas that begin a parameter, outside brackets."""
    depths = _depths(text)
    if min(depths, default=0) < 0:
        raise ValueError('found "]" without "["')
    if depths and depths[-1] > 0:
        raise ValueError('found "[" without "]"')
    start = 0
    for index, depth in enumerate(depths):
        if text[index] == "," and depth == 0 and re.match(r"\w+=", text[index + 1 :]):
            yield text[start:index]
            start = index + 1
    if text:
        yield text[start:]


def _depths(text: str) -> list[int]:
    """The number of open brackets after each character."""
    return list(accumulate((character == "[") - (character == "]") for character in text))


def _parse_value(text: str) -> Any:
    if text.startswith("["):
        if _depths(text).index(0) < len(text) - 1:
            raise ValueError(f'expected nothing after "]" but a comma and key=, found "{text}"')
        return _parse(text[1:-1])
    if text in ("true", "false"):
        return text == "true"
    if re.fullmatch(r"[+-]?\d+", text):
        return int(text)
    if re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", text):
        return float(text)
    return text
