"""Candidates for shell completion: scenes, folders, variants, integrators and their parameters.
This module does not import Mitsuba, which would take a second."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..inputs import names
from ..inputs.scene_changes import FILTERS
from ..startup import plugin_folders, plugin_parameters

if TYPE_CHECKING:
    import click
    from click.shell_completion import CompletionItem

#: The type of an incomplete candidate, after which no space is written.
PART = "part"

#: The Boolean parameters of Mitsuba's integrators.
_SWITCHES = ("hide_emitters", "use_spectral_mis", "srgb_primitives", "guiding_proj")


def integrators(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Integrators, ``NAME:key=value,…``, and files that contain an integrator or a scene."""
    return _items([*_files(text, (".xml", ".json")), *_specifications(text)])


def scenes(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Scene files."""
    return _items(_files(text, (".xml",)))


def modules(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Python files."""
    return _items(_files(text, (".py",)))


def folders(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Folders."""
    return _items(_files(text, ()))


def plugins(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Plugins of this package, of any kind."""
    found = sorted(name for of_kind in plugin_folders.plugin_names().values() for name in of_kind)
    return _items((name, "plain") for name in found if name.startswith(text))


def filters(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Reconstruction filters."""
    return _items((name, "") for name in FILTERS if name.startswith(text))


def variants(_context: click.Context, _option: Any, text: str) -> list[CompletionItem]:
    """Mitsuba's variants, each of which is a module of the package."""
    spec = PathFinder.find_spec("mitsuba")
    found = []
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        files = [file.name.partition(".")[0] for file in Path(folder).glob("*_*.*")]
        found += [name for name in files if re.match(r"(scalar|llvm|cuda)_", name)]
    return _items((name, "plain") for name in sorted(set(found)) if name.startswith(text))


def _items(found: Iterable[tuple[str, str]]) -> list[CompletionItem]:
    from click.shell_completion import CompletionItem

    return [CompletionItem(value, type=kind) for value, kind in found]


def _files(text: str, suffixes: tuple[str, ...]) -> list[tuple[str, str]]:
    """The folders and files whose paths begin with ``text``."""
    folder, slash, begin = text.rpartition("/")
    base = Path(folder + slash).expanduser() if slash else Path()
    try:
        entries = sorted(base.iterdir())
    except OSError:
        return []
    found = []
    for entry in entries:
        is_hidden = entry.name.startswith(".") and not begin.startswith(".")
        if is_hidden or not entry.name.startswith(begin):
            continue
        if entry.is_dir():
            found.append((f"{folder}{slash}{entry.name}/", PART))
        elif entry.suffix.lower() in suffixes:
            found.append((f"{folder}{slash}{entry.name}", "plain"))
    return found


def _specifications(text: str) -> list[tuple[str, str]]:
    """The possible continuations of ``NAME:key=value,key=[NAME:…],…``."""
    before, inner = _innermost(text)
    name, colon, rest = inner.partition(":")
    if not colon:
        known = [*plugin_folders.plugin_names()["integrators"], *names.MITSUBA_INTEGRATORS]
        if before:
            known += plugin_folders.decision_names()
        return [(before + other, PART) for other in sorted(known) if other.startswith(name)]
    done, comma, last = _last_parameter(rest)
    before += f"{name}:{done}{comma}"
    kinds = _parameters(name)
    key, equals, value = last.partition("=")
    if equals:
        values = ("false", "true") if "bool" in kinds.get(key, "") else ()
        return [(f"{before}{key}={other}", PART) for other in values if other.startswith(value)]
    taken = set(re.findall(r"(?:^|,)(\w+)=", done))
    keys = [other for other in kinds if other.startswith(key) and other not in taken]
    return [(f"{before}{other}=", PART) for other in keys]


def _parameters(name: str) -> dict[str, str]:
    """The types of a plugin's parameters."""
    if name in names.MITSUBA_INTEGRATORS:
        return {
            key: "bool" if key in _SWITCHES else "" for key in names.MITSUBA_INTEGRATORS[name]
        }
    return {
        key: row.type for row in plugin_parameters.parameter_rows(name)
        for key in row.name.split(", ") if key.isidentifier()
    }  # fmt: skip


def _innermost(text: str) -> tuple[str, str]:
    """The text up to the last open bracket, and the text after it."""
    opened: list[int] = []
    for index, letter in enumerate(text):
        if letter == "[":
            opened.append(index + 1)
        elif letter == "]" and opened:
            opened.pop()
    start = opened[-1] if opened else 0
    return text[:start], text[start:]


def _last_parameter(text: str) -> tuple[str, str, str]:
    """The parameters before the last comma outside brackets, the comma, and the rest."""
    depth, cut = 0, -1
    for index, letter in enumerate(text):
        depth += (letter == "[") - (letter == "]")
        if letter == "," and depth == 0:
            cut = index
    return (text[:cut], ",", text[cut + 1 :]) if cut >= 0 else ("", "", text)
