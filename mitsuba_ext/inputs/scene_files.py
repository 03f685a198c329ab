"""The files of a scene: its XML files, and all files named in them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

if TYPE_CHECKING:
    import mitsuba as mi


def files_of(state: mi.parser.ParserState, parameters: Mapping[str, str]) -> list[Path]:
    """The absolute paths of a parsed scene's files: XML files, meshes, textures, spectra.

    Args:
        state: The parsed scene, before any transformation.
        parameters: Values of the ``$name`` placeholders.
    """
    files = {_absolute(str(file)) for file in state.files}
    names = [name for _, name in named_in(state)]
    names += [name for _, name in _named_in_xml(sorted(files), parameters)]
    for name in names:
        file = _resolved(name)
        if file.is_file():
            files.add(file)
    return sorted(files)


def parameters_of(path: Path) -> list[str]:
    """The ``$name`` parameters of an XML file, and of the files beside it that it includes."""
    names: dict[str, None] = {}
    for file in (path, *_included(path)):
        text = file.read_text(encoding="utf-8", errors="replace")
        names.update(dict.fromkeys(re.findall(r"\$(\w+)", text)))
    return list(names)


def _included(path: Path) -> list[Path]:
    text = path.read_text(encoding="utf-8", errors="replace")
    found = re.findall(r"<include\s[^>]*filename=[\"']([^\"'$]+)[\"']", text)
    return [path.parent / name for name in found if (path.parent / name).is_file()]


def named_by_absolute_path(files: list[Path], parameters: Mapping[str, str]) -> list[str]:
    """The included files and the spectra that XML files name by absolute paths."""
    return [name for _, name in _named_in_xml(files, parameters) if Path(name).is_absolute()]


def named_in(state: mi.parser.ParserState) -> Iterator[tuple[tuple[object, str], str]]:
    """The string parameters (possibly file names) of a scene's plugins, with nodes and keys."""
    import mitsuba as mi

    for node in state.nodes:
        properties = mi.Properties(node.props)  # a copy: reading a property marks it as queried
        for key in properties.keys():
            if properties.type(key) == mi.Properties.Type.String and properties[key]:
                yield (node, key), properties[key]


def _named_in_xml(files: list[Path], parameters: Mapping[str, str]) -> Iterator[tuple[Path, str]]:
    """The files named in ``filename`` attributes: included files and spectra. The parser replaces
    both by their contents."""
    elements = []
    values = {}
    for file in files:
        if file.suffix.lower() != ".xml":
            continue
        try:
            found = list(ElementTree.parse(file).iter())
        except (OSError, ElementTree.ParseError):
            continue
        elements += [(file, element) for element in found]
        values.update((e.get("name", ""), e.get("value", "")) for e in found if e.tag == "default")
    values.update(parameters)
    for file, element in elements:
        if name := element.get("filename"):
            # Longer names first: $size_x is not $size followed by "_x"
            for key in sorted(values, key=len, reverse=True):
                name = name.replace(f"${key}", values[key])
            yield file, name


def _resolved(name: str) -> Path:
    import mitsuba as mi

    return _absolute(str(mi.file_resolver().resolve(name)))


def _absolute(name: str) -> Path:
    return Path(os.path.abspath(name))
