"""Names of integrators, of plugins that can be nested in them, and of parameters; suggestions for
misspelt names.

This module does not import Mitsuba, which takes a second, so that a misspelt name is reported at
once.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..startup import registry
from .pages import Parameter, read_page
from .plugin_text import parse_plugin

#: Mitsuba's own integrators.
MITSUBA_INTEGRATORS = (
    "aov", "depth", "direct", "direct_projective", "moment", "path", "prb", "prb_basic",
    "prb_projective", "prbvolpath", "ptracer", "stokes", "volpath", "volpathmis",
    "volprim_rf_basic",
)  # fmt: skip


#: Stands for the scene's own integrator, where one is named.
OF_SCENE = "scene"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``': did you mean "neepp"?'``, or nothing if no known name resembles ``name``."""
    close = difflib.get_close_matches(name.lower(), known, n=1)
    return f': did you mean "{close[0]}"?' if close else ""


def unknown_plugin(name: str, is_nested: bool = False) -> InputError:
    """The error for a name that no integrator has and, if ``is_nested``, no decision either."""
    kind = "nested plugin" if is_nested else "integrator"
    if name in _ours(is_nested=True):
        return InputError(
            f'"{name}" is no integrator, but a decision to be nested in one '
            f"('mitsuba-ext list {name}' shows how)"
        )
    hint = did_you_mean(name, [*_ours(is_nested), *MITSUBA_INTEGRATORS])
    return InputError(f'unknown {kind} "{name}"{hint} (\'mitsuba-ext list\' shows ours)')


def unknown_parameter(kind: str, name: str, key: str) -> InputError:
    """The error for a parameter that a plugin did not read.

    Args:
        kind: What the plugin is, for the message: "integrator" or "nested plugin".
        name: Its name.
        key: The name of the parameter.
    """
    known = parameter_names(name)
    if key in known:
        return InputError(
            f'{kind} "{name}": nothing here uses the parameter "{key}": leave it out '
            f"('mitsuba-ext list {name}' says what it is for)"
        )
    return InputError(f'{kind} "{name}" has no parameter "{key}"{did_you_mean(key, known)}')


def parameter_names(name: str) -> list[str]:
    """The parameters of a plugin of this package, from its page; none for other plugins."""
    return [key for row in parameter_rows(name) for key in row.name.split(", ")]


def parameter_rows(name: str) -> list[Parameter]:
    """The rows of the parameter table of a plugin of this package; none for other plugins."""
    files = [file for kind in registry.plugin_names() for file in registry.plugin_files(kind)]
    pages = [read_page(file) for file in files if file.stem == name]
    return [row for page in pages for row in page.parameters]


def check_integrator(specification: str) -> None:
    """Refuses an unknown integrator, or an unknown plugin inside of one, before Mitsuba is
    imported. (Afterwards, plugins of the user may be registered, and this does nothing.)

    Args:
        specification: A file, text that begins with the integrator's name, or :data:`OF_SCENE`.

    Raises:
        InputError: There is no such plugin, or the text has another form.
    """
    is_file = Path(specification).suffix.lower() in (".xml", ".json")
    if specification == OF_SCENE:
        return
    if not is_file and "mitsuba" not in sys.modules:  # otherwise it is checked later
        _check_plugin(parse_plugin(specification))


def _check_plugin(plugin: Mapping[str, Any], is_nested: bool = False) -> None:
    name = plugin["type"]
    is_known = name in (*_ours(is_nested), *MITSUBA_INTEGRATORS)
    if not is_known and not is_file_of_mitsuba(name):
        raise unknown_plugin(name, is_nested)
    for value in plugin.values():
        if isinstance(value, Mapping):
            _check_plugin(value, is_nested=True)


def _ours(is_nested: bool) -> list[str]:
    """The names of our integrators and, with ``is_nested``, of our decisions."""
    integrators = registry.plugin_names()["integrators"]
    return [*integrators, *(registry.decision_names() if is_nested else ())]


def is_file_of_mitsuba(name: str) -> bool:
    """Is there a plugin in C++ of this name? ``True`` also if Mitsuba is not found."""
    spec = PathFinder.find_spec("mitsuba")
    if spec is None or not spec.submodule_search_locations:
        return True
    folder = Path(spec.submodule_search_locations[0]) / "plugins"
    return any((folder / f"{name}{suffix}").exists() for suffix in (".so", ".dylib", ".dll"))
