"""The arguments of a plugin's function, from the plugin's page."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

from ..startup.pages import Parameter
from ..startup.plugin_folders import KINDS, plugin_files
from ..startup.plugin_parameters import parameter_rows

#: The types of a page, and what an editor shows for them (names of the stub).
_TYPES = {
    "bool": "bool", "int": "int", "float": "float", "string": "str", "integrator": "Plugin",
    "decision": "Plugin", "emitter": "Plugin", "sensor": "Plugin", "shape": "Plugin",
    "bsdf": "Plugin", "texture": "Texture", "spectrum": "Spectrum", "vector": "Vector",
    "point": "Vector", "transform": "Transform",
}  # fmt: skip

#: The rows of plugins that are nested, and of the parameters of another plugin.
_NESTED, _PARAMETERS_OF = "(nested plugin)", re.compile(r"\(Parameters of (\w+)\)")


@dataclass(frozen=True)
class Argument:
    """An argument of a function.

    Attributes:
        name: Its name; the parameter's name in a scene.
        type: Its type, as the stub writes it.
        default: Its default as Python writes it; ``...`` if that depends on something else, or if
            there is none.
        row: The row of the page that describes it.
        is_nested: Whether it stands for nested plugins, which have no name of their own.
        is_first: Whether it is the first of numbered ones, such as ``pose_0``, ``pose_1``, ….
    """

    name: str
    type: str
    default: str
    row: Parameter
    is_nested: bool = False
    is_first: bool = False


@functools.cache
def arguments(plugin: str) -> tuple[Argument, ...]:
    """The arguments of the function for a plugin, in the order of its page."""
    found: dict[str, Argument] = {}
    for row in parameter_rows(plugin):
        for argument in _of_row(row):
            found.setdefault(argument.name, argument)
    return tuple(found.values())


def plugin_names() -> list[str]:
    """The plugins that have a function, sorted by name."""
    return sorted(file.stem for kind in KINDS for file in plugin_files(kind))


def _of_row(row: Parameter) -> list[Argument]:
    if other := _PARAMETERS_OF.fullmatch(row.name):
        return list(arguments(other.group(1)))
    if row.name.lower() == _NESTED:
        kinds = "Plugin | Sequence[Plugin]" if "several" in row.type else "Plugin"
        return [Argument("nested", kinds, "...", row, is_nested=True)]
    names = row.name.split(", ")
    defaults = row.default.split(", ")
    if len(defaults) != len(names):
        defaults = [row.default] * len(names)
    made, is_numbered = [], "…" in names
    for name, default in zip(names, defaults):
        if name == "…":
            continue
        kind = _type_of(row.type)
        value = "..." if is_numbered else _literal(default, kind)
        made.append(Argument(name, kind, value, row, is_first=is_numbered and name.endswith("_0")))
    return made


def _type_of(text: str) -> str:
    """The type that a page names, as the stub writes it."""
    names = [_TYPES.get(word) for word in re.split(r", | or ", text)]
    if None in names:
        return "Any"
    return " | ".join(dict.fromkeys(names))


def _literal(text: str, kind: str) -> str:
    """A default of a page as Python writes it."""
    if text in ("true", "false") and kind in ("bool", "Any"):
        return text.capitalize()
    kinds = kind.split(" | ")
    if re.fullmatch(r"-?\d+(\.\d+)?", text) and {"int", "float", "Any", "Spectrum"} & {*kinds}:
        return text
    if re.fullmatch(r"\w+", text) and "str" in kinds:
        return '""' if text == "none" else f'"{text}"'
    return "..."
