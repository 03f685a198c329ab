"""The parameters of our plugins, from their pages; the error for an unread parameter.

Mitsuba also refuses parameters that a plugin did not read, but suggests no name.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..util.errors import did_you_mean
from .pages import Parameter, read_page
from .plugin_folders import KINDS, plugin_files

if TYPE_CHECKING:
    import mitsuba as mi

#: Parameters of earlier versions, and those that replace them.
_REPLACED = {"save_map": "save_learned", "load_map": "load_learned"}


@functools.cache
def parameter_rows(name: str) -> list[Parameter]:
    """The rows of a plugin's parameter table; none for plugins of other packages."""
    files = (file for kind in KINDS for file in plugin_files(kind) if file.stem == name)
    pages = [read_page(file) for file in files]
    return [row for page in pages for row in page.parameters]


def parameter_names(name: str) -> list[str]:
    """The parameters on a plugin's page; none for plugins of other packages."""
    return [key for row in parameter_rows(name) for key in row.name.split(", ")]


def unread(name: str, key: str, others: Sequence[str] = ()) -> str:
    """Says that a plugin does not read a parameter, and suggests the one that was probably meant.

    Args:
        name: The plugin.
        key: The parameter.
        others: The known parameters of a plugin of another package.
    """
    ours = parameter_names(name)
    if ours and key in _REPLACED:
        return (
            f'"{name}" has no parameter "{key}" any more: use the parameter "{_REPLACED[key]}" '
            f"of the integrator"
        )
    if key in ours:
        return (
            f'"{name}": nothing here uses the parameter "{key}": leave it out '
            f"('mitsuba-ext list {name}' says what it is for)"
        )
    hint = did_you_mean(key, ours or others)
    if ours and not hint:
        hint = f" ('mitsuba-ext list {name}' shows its parameters)"
    return f'"{name}" has no parameter "{key}"{hint}'


def refuse_unread(plugin: mi.Object, props: mi.Properties) -> None:
    """
    Args:
        plugin: A plugin of this package.
        props: The parameters that the scene gives.

    Raises:
        ValueError: The plugin did not read a parameter.
    """
    keys = props.unqueried()
    if not keys:
        return
    name, key, value = props.plugin_name(), keys[0], props[keys[0]]
    if key.startswith("_arg_"):
        raise ValueError(f'"{name}": {_nameless(value)}')
    message = unread(name, key)
    is_explained = key in _REPLACED or "did you mean" in message
    if hasattr(plugin, "technique") and not is_explained:
        message += f"; it is for nesting in an integrator, with {_names(plugin)}"
    raise ValueError(message)


def _nameless(value: Any) -> str:
    """Says that a nested plugin without a name cannot be used."""
    what = getattr(value, "name", None) or value.class_name()
    if not hasattr(value, "technique"):
        return f'nothing here uses the nested "{what}": leave it out'
    return f'the nested "{what}" needs the name of what it decides: {_names(value)}'


def _names(decision: Any) -> str:
    """The names under which a decision can be nested."""
    return " or ".join(f'name="{slot}"' for slot in decision.technique.slots)
