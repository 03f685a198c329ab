"""The page of a plugin, read from its docstring without running its file.

Docstrings have Mitsuba's form: a title underlined with dashes, a ``.. pluginparameters::`` list of
name, type and description (which ends in ``(Default: …)``), and prose. A row named ``(Common
parameters)`` stands for the list in the base class's docstring, except for parameters that the
plugin itself describes.
"""

from __future__ import annotations

import ast
import inspect
import re
from dataclasses import dataclass, replace
from pathlib import Path

#: The row that stands for the parameters of the base class.
_COMMON = "(Common parameters)"

_LIST = ".. pluginparameters::"


@dataclass(frozen=True)
class Parameter:
    """A row of a plugin's parameter table. ``default`` is empty for a required parameter."""

    name: str
    type: str
    default: str
    description: str


@dataclass(frozen=True)
class Page:
    """The page of a plugin; ``text`` is its docstring without title and parameters."""

    name: str
    title: str
    parameters: tuple[Parameter, ...]
    text: str

    @property
    def summary(self) -> str:
        """The first paragraph, in one line."""
        return " ".join(self.text.split("\n\n")[0].split())


def read_page(file: Path) -> Page:
    """The page of the plugin in ``file``, whose name is the plugin's name."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    # A file has one plugin class; helper classes have no parameter list
    classes.sort(key=lambda node: _LIST not in _docstring(node))
    return _class_page(file, tree, classes[0]) if classes else parse_page(file.stem, "")


def parse_page(name: str, docstring: str) -> Page:
    """Splits a docstring into title, parameter list and prose."""
    lines = inspect.cleandoc(docstring).splitlines()
    lines = [line for line in lines if not re.match(r"\.\. _[\w-]+:$", line)]
    title = ""
    for index in range(1, len(lines)):
        if re.fullmatch(r"([-=~^])\1{2,}", lines[index]):
            title = _plain(lines[index - 1].strip())
            lines = lines[: index - 1] + lines[index + 1 :]
            break
    start = next((i for i, line in enumerate(lines) if _LIST in line), None)
    parameters: tuple[Parameter, ...] = ()
    if start is not None:
        end = start + 1
        while end < len(lines) and (not lines[end] or lines[end][0].isspace()):
            end += 1
        parameters = tuple(_parameters(lines[start + 1 : end]))
        lines = lines[:start] + lines[end:]
    text = re.sub(r"^ *\.\. (?:tabs::|code-tab:: \w+) *\n", "", "\n".join(lines), flags=re.M)
    text = re.sub(r"\n{3,}", "\n\n", _plain(text)).strip()
    return Page(name, title, parameters, text)


def _class_page(file: Path, tree: ast.Module, cls: ast.ClassDef) -> Page:
    """The page of a class, with the parameters of its base class."""
    page = parse_page(file.stem, _docstring(cls))
    own = {parameter.name for parameter in page.parameters}
    rows: list[Parameter] = []
    for parameter in page.parameters:
        if parameter.name == _COMMON:
            base = _base_class(file, tree, cls)
            while _LIST not in _docstring(base[2]):  # an intermediate class that adds no parameters
                base = _base_class(*base)
            common = _class_page(*base).parameters
            rows += [row for row in common if row.name not in own]
        else:
            rows.append(parameter)
    return replace(page, parameters=tuple(rows))


def _base_class(
    file: Path, tree: ast.Module, cls: ast.ClassDef
) -> tuple[Path, ast.Module, ast.ClassDef]:
    """The base class, which ``file`` defines or imports from this package: its file, the file's
    syntax tree, and the class definition.

    Raises:
        ValueError: The base class is not found.
    """
    bases = {base.id for base in cls.bases if isinstance(base, ast.Name)}
    for definition in tree.body:
        if isinstance(definition, ast.ClassDef) and definition.name in bases:
            return file, tree, definition
    for node in tree.body:
        names = {alias.name for alias in node.names} if isinstance(node, ast.ImportFrom) else set()
        if bases & names:
            module = node.module or ""
            folder = file.parents[node.level - 1] if node.level else Path(__file__).parents[2]
            base_file = folder.joinpath(*module.split(".")).with_suffix(".py")
            base_tree = ast.parse(base_file.read_text(encoding="utf-8"))
            for definition in base_tree.body:
                if isinstance(definition, ast.ClassDef) and definition.name in bases:
                    return base_file, base_tree, definition
    raise ValueError(f"{file}: {cls.name} has no base class with {_COMMON}")


def _docstring(cls: ast.ClassDef) -> str:
    return ast.get_docstring(cls, clean=False) or ""


def _parameters(lines: list[str]) -> list[Parameter]:
    """Reads ``* - name``, ``- type`` and ``- description``, each continued on indented lines."""
    rows: list[list[str]] = []
    for line in lines:
        first = re.match(r"\s*\* - (.*)", line)
        # A deeper "-" is a list inside a description
        cell = re.match(r"\s{1,3}- (.*)", line)
        if first:
            rows.append([first.group(1)])
        elif rows and cell:
            rows[-1].append(cell.group(1))
        elif rows:
            rows[-1][-1] += " " + line.strip()
    parameters = []
    for row in rows:
        name, kind, description = (_plain(" ".join(cell.split())) for cell in [*row, "", ""][:3])
        default = re.search(r"\s*\(Default: (.*?)\)(?=\s|$)", description)
        if default:
            description = description[: default.start()] + description[default.end() :]
        parameters.append(
            Parameter(name, kind, default.group(1) if default else "", description.strip())
        )
    return parameters


def _plain(text: str) -> str:
    """reStructuredText without its inline markup."""
    text = re.sub(r":\w+(?::\w+)?:`([^`]*)`", r"\1", text)
    text = re.sub(r"``([^`]*)``", r"\1", text)
    text = re.sub(r"(?<![\w|])\|(\w+)\|(?!\w)", r"\1", text)
    text = text.replace("\\infty", "∞")
    # Stars remain in code, which is indented
    blocks = re.split(r"(\n{2,})", text)
    return "".join(block if block[:1].isspace() else _without_stars(block) for block in blocks)


def _without_stars(text: str) -> str:
    """reStructuredText without strong and emphasis marks."""
    text = re.sub(r"\*\*(?=\S)(.+?)(?<=\S)\*\*", r"\1", text, flags=re.S)
    return re.sub(r"(?<![\w*])\*(?=[^\s*])([^*]+?)(?<=\S)\*(?![\w*])", r"\1", text)
