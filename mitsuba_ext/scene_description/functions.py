"""Makes the functions of plugins."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..startup.pages import read_page
from ..startup.plugin_folders import KINDS, plugin_files
from ..startup.plugin_parameters import unread
from .arguments import Argument, arguments


def function_of(plugin: str) -> Callable[..., dict[str, Any]]:
    """The function that returns the dict of a plugin. It accepts the parameters of the plugin's
    page by name."""
    known = arguments(plugin)
    numbered = [argument.name[:-1] for argument in known if argument.is_first]
    names = {argument.name for argument in known}

    def make(*, id: str | None = None, **values: Any) -> dict[str, Any]:
        made: dict[str, Any] = {"type": plugin}
        if id is not None:
            made["id"] = id
        for name, value in values.items():
            is_numbered = any(re.fullmatch(rf"{stem}\d+", name) for stem in numbered)
            if name not in names and not is_numbered:
                raise TypeError(unread(plugin, name))
            if value is None:
                continue
            if name == "nested":
                made |= _nested(value)
            else:
                made[name] = _plain(value)
        return made

    make.__name__ = make.__qualname__ = plugin
    make.__module__ = "mitsuba_ext.scene_description"
    make.__doc__ = _documentation(plugin, known)
    make.__signature__ = _signature(known, bool(numbered))
    return make


def _nested(value: Any) -> dict[str, Any]:
    """Nested plugins under names that no parameter has."""
    if isinstance(value, Sequence):
        return {f"nested_{index}": _plain(item) for index, item in enumerate(value)}
    return {"nested": _plain(value)}


def _plain(value: Any) -> Any:
    """The value as ``mi.load_dict`` takes it: objects of mitsuba-scene-description become dicts and
    transforms."""
    for method in ("to_dict", "to_mi"):
        if hasattr(value, method):
            return getattr(value, method)()
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return value


def _documentation(plugin: str, known: Sequence[Argument]) -> str:
    (file,) = (file for kind in KINDS for file in plugin_files(kind) if file.stem == plugin)
    page = read_page(file)
    rows = dict.fromkeys(argument.row for argument in known)
    lines = [
        f"    {row.name} ({row.type}): {row.description}"
        + (f" (Default: {row.default})" if row.default else "")
        for row in rows
    ]
    return "\n".join([f"{page.title}.", "", page.summary, "", "Parameters:", *lines])


def _signature(known: Sequence[Argument], has_numbered: bool) -> inspect.Signature:
    parameters = [
        inspect.Parameter(
            argument.name, inspect.Parameter.KEYWORD_ONLY, annotation=argument.type,
            default=None if argument.default == "..." else _Shown(argument.default),
        )
        for argument in known
    ]  # fmt: skip
    parameters.append(inspect.Parameter("id", inspect.Parameter.KEYWORD_ONLY, default=None))
    if has_numbered:
        parameters.append(inspect.Parameter("numbered", inspect.Parameter.VAR_KEYWORD))
    return inspect.Signature(parameters)


class _Shown:
    """A default that ``help()`` and notebooks show; the function itself leaves the parameter out of
    the dict."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
