"""The reference of the plugins: the file of a plugin is a page, which its docstring writes.

The docstrings have the form of Mitsuba's. This extension knows what they use: the directive
``pluginparameters``, the roles ``monosp`` and ``class``, and names of types such as ``|int|``. Base
classes with parameters of their own have pages, too. ``{plugins} KIND`` lists the pages of a kind,
and ``{gallery}`` shows the pictures of all of them.
"""

from __future__ import annotations

import ast
import functools
import inspect
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx import addnodes
from sphinx.parsers import RSTParser
from sphinx.util.docutils import SphinxDirective, SphinxRole
from sphinx.util.logging import getLogger

from mitsuba_ext.startup import pages, plugin_folders

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
_PICTURES = "docs/pictures"
_LIST = ".. pluginparameters::"

#: What stands for a type in a list of parameters.
_TYPES = (
    "bitmap", "bool", "bsdf", "decision", "emitter", "float", "int", "integrator", "point",
    "sensor", "several", "shape", "spectrum", "string", "tensor", "texture", "transform", "vector",
)  # fmt: skip
_PROLOG = [*(f".. |{name}| replace:: {name}" for name in _TYPES), ""]

_log = getLogger(__name__)


@functools.cache
def kinds() -> dict[str, list[Path]]:
    """The files of each list: those of the registry's kinds, decisions, and base classes."""
    found = {kind: plugin_folders.plugin_files(kind) for kind in plugin_folders.plugin_names()}
    decisions = plugin_folders.decision_names()
    samplers = found["samplers"]
    found["decisions"] = [file for file in samplers if file.stem in decisions]
    found["samplers"] = [file for file in samplers if file.stem not in decisions]
    found["bases"] = [
        file
        for file in sorted([
            *(ROOT / "mitsuba_ext" / "bases").glob("*.py"), *(ROOT / "integrators").glob("_*.py")
        ])
        if _LIST in file.read_text(encoding="utf-8")
    ]
    return found


def files() -> list[str]:
    """The files that are pages, as paths from the root of the repository."""
    return [_path(file) for group in kinds().values() for file in group]


def docname(file: Path) -> str:
    """The name that Sphinx has for the page of a plugin."""
    return _path(file).removesuffix(".py")


def _path(file: Path) -> str:
    return file.resolve().relative_to(ROOT).as_posix()


@functools.cache
def _pages_by_name() -> dict[str, str]:
    """What ``:class:`` can name: plugins, and base classes."""
    found = {}
    for kind, group in kinds().items():
        for file in group:
            found[_class_name(file) if kind == "bases" else file.stem] = docname(file)
    return found


def plugin_class(tree: ast.Module) -> ast.ClassDef:
    """The class of a file that has a list of parameters."""
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    return next(node for node in classes if _LIST in (ast.get_docstring(node) or ""))


def _title(file: Path) -> str:
    """Without the plugin's name. Base classes have no title."""
    title = pages.read_page(file).title
    if title:
        return title.removesuffix(f"({file.stem})").strip()
    return f"Common parameters: {_class_name(file)}"


def _class_name(file: Path) -> str:
    return plugin_class(ast.parse(file.read_text(encoding="utf-8"))).name


class PluginParser(RSTParser):
    """Reads the docstring of a plugin's class as reStructuredText."""

    supported = ("plugin",)

    def parse(self, inputstring: str | StringList, document: nodes.document) -> None:
        code = inputstring if isinstance(inputstring, str) else "\n".join(inputstring)
        file = ROOT / f"{document.settings.env.docname}.py"
        text = _docstring(file, plugin_class(ast.parse(code)))
        super().parse(StringList(_PROLOG, "types") + text, document)
        section = document.next_node(nodes.section)
        if section is None:
            return
        first = section.first_child_matching_class(nodes.paragraph) or 0
        section.insert(first + 1, _picture(file, document))
        link = CodeLink(path=_path(file))
        link += nodes.literal(text=_path(file))
        section += nodes.paragraph("", "Source code: ", link)


class CodeLink(nodes.Inline, nodes.TextElement):
    """A link to the source text of a file of the repository; ``offline.py`` makes its page."""


def _docstring(file: Path, cls: ast.ClassDef) -> StringList:
    """The lines of a docstring, and where they are."""
    raw = ast.get_docstring(cls, clean=False) or ""
    start = cls.body[0].lineno - 1 + raw[: len(raw) - len(raw.lstrip())].count("\n")
    lines = inspect.cleandoc(raw).splitlines()
    text = StringList(items=[(str(file), start + i) for i in range(len(lines))], initlist=lines)
    if pages.read_page(file).title:
        return text
    # A base class has no title, and what follows this line is for those who write a subclass
    for_users = next((i for i, line in enumerate(lines) if re.match("Attr|Param", line)), None)
    title = _title(file)
    return StringList([title, "=" * len(title), ""], str(file)) + text[:for_users]


def _picture(file: Path, document: nodes.document) -> list[nodes.Node]:
    """What the plugin does, in a picture, if there is one."""
    picture, caption = (ROOT / _PICTURES / f"{file.stem}{end}" for end in (".jpg", ".txt"))
    if not picture.exists():
        return []
    text = caption.read_text(encoding="utf-8").strip() if caption.exists() else ""
    figure = nodes.figure("", nodes.image(uri=f"/{_path(picture)}", alt=text or file.stem))
    if text:
        figure += nodes.caption("", text)
    return [figure]


class ParameterList(Directive):
    """A list of parameters: ``* - name``, ``- type`` and ``- description`` for each."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        parsed = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, parsed)
        parameters = nodes.definition_list(classes=["parameters"])
        for row in parsed.findall(nodes.list_item):
            if row.parent.parent is not parsed:
                continue  # a cell, or a list inside a description
            cells = list(row[0])
            if len(cells) != 3:
                raise self.error("A parameter needs a name, a type and a description.")
            parameters += _parameter(*cells)
        return [parameters]


def _parameter(name: nodes.Element, kind: nodes.Element, text: nodes.Element) -> nodes.Element:
    label = name.astext()
    term = nodes.term()
    if label.startswith("("):
        term += nodes.inline(text=label.strip("()"))
    else:
        term["ids"] = [f"parameter-{each}" for each in label.split(", ")]
        term += nodes.literal(text=label)
    types = nodes.inline(classes=["type"])
    types += kind[0].children if len(kind) else []
    if types.astext().strip():
        term += [nodes.Text(" "), types]
    return nodes.definition_list_item("", term, nodes.definition("", *text.children))


class ClassRole(SphinxRole):
    """``:class:`name```: the page of a plugin or of a base class."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        target = _pages_by_name().get(self.text)
        if target is None:
            _log.warning("no plugin or base class %r", self.text, location=self.get_location())
            return [nodes.literal(text=self.text)], []
        return [_link(target, self.text)], []


def _link(page: str, text: str) -> addnodes.pending_xref:
    """A link to a page of the site, such as :func:`docname` names it."""
    target = {"refdomain": "std", "reftype": "doc", "reftarget": f"/{page}"}
    return addnodes.pending_xref(
        "", nodes.literal(text=text), refexplicit=True, refwarn=True, **target
    )


class PluginList(SphinxDirective):
    """The pages of a kind, with what each is, and in the table of contents."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        group = kinds()[self.arguments[0]]
        listed = nodes.definition_list(classes=["plugins"])
        entries = []
        for file in group:
            self.env.note_dependency(str(file))
            page = pages.read_page(file)
            name = file.stem if page.title else _class_name(file)
            term = nodes.term("", "", _link(docname(file), name))
            if page.title:
                term += nodes.Text(f" {_title(file)}")
            sentence = re.match(r".*?\.(?= |$)", page.summary)
            text = sentence.group() if sentence else page.summary
            definition = nodes.definition("", nodes.paragraph("", text))
            listed += nodes.definition_list_item("", term, definition)
            entries.append((name, docname(file)))
        names = [name for _, name in entries]
        toctree = addnodes.toctree(
            parent=self.env.docname, entries=entries, includefiles=names,
            maxdepth=1, caption=None, glob=False, hidden=True, includehidden=False, numbered=0,
            titlesonly=True,
        )  # fmt: skip
        return [listed, nodes.compound("", toctree, classes=["toctree-wrapper"])]


class Gallery(SphinxDirective):
    """The pictures of all plugins, each under the plugin's name."""

    def run(self) -> list[nodes.Node]:
        shown: list[nodes.Node] = []
        for kind in ("integrators", "decisions", "samplers", "emitters", "shapes"):
            for file in kinds()[kind]:
                picture = _picture(file, self.state.document)
                if picture:
                    heading = _link(docname(file), file.stem)
                    shown += [nodes.paragraph("", "", heading, classes=["rubric"]), *picture]
        return shown


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_source_suffix(".py", "plugin")
    app.add_source_parser(PluginParser)
    app.add_directive("pluginparameters", ParameterList)
    app.add_directive("plugins", PluginList)
    app.add_directive("gallery", Gallery)
    app.add_generic_role("monosp", nodes.literal)
    app.add_generic_role("meth", nodes.literal)
    app.add_role("class", ClassRole())
    app.add_node(CodeLink)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
