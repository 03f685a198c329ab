"""Imports point one way: plugins → bases → techniques, estimators → planning → rendering →
transport → scene → util; ``pointsets`` needs nobody's scene, and no two rooms import each other."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGE = ROOT / "mitsuba_ext"

#: The folders of plugins, which are installed as parts of the package.
PLUGINS = ("integrators", "emitters", "bsdfs", "shapes", "samplers", "sensors")

#: Arrays of Dr.Jit, as Mitsuba calls them.
_ARRAYS = ("Float", "Float64", "UInt32", "UInt64", "Int32", "Bool")

#: The floors of the house, from the ground up: a room imports rooms of lower floors only.
FLOORS = (
    ("util",),
    ("scene", "startup"),
    ("images", "inputs", "scene_description", "transport"),
    ("rendering",),
    ("long_renders", "planning", "replay"),
    ("compare", "estimators", "live", "techniques"),
    ("bases", "cli"),
    PLUGINS,
)

#: By room, its floor.
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


@functools.cache
def _tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@functools.cache
def _imports(file: Path, package: tuple[str, ...]) -> list[tuple[str, ...]]:
    """The modules that a file imports, anywhere in it, as paths from ``mitsuba_ext``.

    Parameters:
        package: The path of the package that holds the file, ``mitsuba_ext`` included.
    """
    found: list[tuple[str, ...]] = []
    for node in ast.walk(_tree(file)):
        if isinstance(node, ast.Import):
            modules = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *(node.module.split(".") if node.module else [])]
            # What is imported may itself be a module
            modules = [[*base, alias.name] for alias in node.names]
        else:
            continue
        found += [tuple(module[1:]) for module in modules if module[0] == "mitsuba_ext"]
    return found


def _files(folder: Path) -> Iterator[tuple[Path, tuple[str, ...]]]:
    for file in sorted(folder.rglob("*.py")):
        yield file, ("mitsuba_ext", *file.relative_to(PACKAGE).parts[:-1])


@pytest.mark.parametrize("room", [room for room in FLOOR if room not in PLUGINS])
def test_a_room_imports_from_lower_floors_only(room: str) -> None:
    files = list(_files(PACKAGE / room))
    assert files, "the room is gone"
    upward = [
        f"{file.relative_to(ROOT)} imports {'.'.join(module)}"
        for file, package in files
        for module in _imports(file, package)
        if module and module[0] != room and FLOOR.get(module[0], 0) >= FLOOR[room]
    ]
    assert not upward, "\n".join(upward)


def test_every_room_has_a_floor() -> None:
    rooms = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert rooms == set(FLOOR) - set(PLUGINS)


def test_few_modules_stand_loose() -> None:
    loose = {file.stem for file in PACKAGE.glob("*.py")} - {"__init__", "__main__"}
    assert not loose


def test_no_rooms_import_each_other() -> None:
    """No circle of several rooms exists either."""
    imports: dict[str, set[str]] = {}
    for file, package in _files(PACKAGE):
        room = package[1] if len(package) > 1 else file.stem
        imported = {module[0] for module in _imports(file, package) if module}
        imports.setdefault(room, set()).update(imported - {room, "__version__"})
    rooms = dict(imports)
    while True:
        free = {room for room, imported in rooms.items() if not imported & set(rooms)}
        if not free:
            break
        rooms = {room: imported for room, imported in rooms.items() if room not in free}
    assert not rooms, rooms


def test_bsdfs_are_called_in_one_place() -> None:
    """Mitsuba's return numbers that are not finite: ``transport/bsdfs.py`` removes them."""
    calls = {"eval_pdf", "eval", "pdf", "sample", "eval_pdf_sample"}
    found = []
    for folder in (PACKAGE, *(ROOT / plugins for plugins in PLUGINS)):
        for file in sorted(folder.rglob("*.py")):
            for node in ast.walk(_tree(file)):
                is_call = isinstance(node, ast.Attribute) and node.attr in calls
                if is_call and "bsdf" in ast.unparse(node.value).lower():
                    found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}")
    assert all(line.startswith("mitsuba_ext/transport/bsdfs.py") for line in found), found
    assert found, "the calls have other names"


def test_pointsets_need_neither_mitsuba_nor_drjit() -> None:
    for file, _package in _files(PACKAGE / "util" / "pointsets"):
        for node in ast.walk(_tree(file)):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & {"mitsuba", "drjit"}, file


def test_the_parser_of_imports_sees_relative_and_absolute_ones(tmp_path: Path) -> None:
    file = tmp_path / "file.py"
    file.write_text(
        "from ..lights import weights\n"
        "from .maps.grid import Grid\n"
        "from ... import bounds\n"
        "import mitsuba_ext.rendering.plan, numpy\n"
        "def late():\n    from mitsuba_ext.composition import slots\n"
    )
    found = set(_imports(file, ("mitsuba_ext", "decisions", "next_event")))
    assert found == {
        ("decisions", "lights", "weights"), ("decisions", "next_event", "maps", "grid", "Grid"),
        ("bounds",), ("rendering", "plan"), ("composition", "slots"),
    }  # fmt: skip


def test_kernels_read_no_memory_of_numpy_that_may_not_be_aligned() -> None:
    """``from_numpy`` aligns it: otherwise kernels differ from one render to the next by chance."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(_tree(file)):
            if not (isinstance(node, ast.Call) and node.args):
                continue
            called, value = ast.unparse(node.func), ast.unparse(node.args[0])
            is_array = called in {f"mi.{kind}" for kind in _ARRAYS}
            if is_array and (value.startswith("np.") or ".astype(" in value):
                found.append(f"{file.relative_to(ROOT)}:{node.lineno}")
    assert not found


# ---- The tests ----


def test_tests_import_from_the_support_folder_only() -> None:
    found = []
    for file in sorted((ROOT / "tests").rglob("*.py")):
        for node in ast.walk(_tree(file)):
            if isinstance(node, ast.ImportFrom):
                modules = ["." * node.level + (node.module or "")]
            elif isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                continue
            found += [
                f"{file.relative_to(ROOT)}:{node.lineno} imports {module}"
                for module in modules
                if module.startswith((".", "test", "conftest"))
                and not f"{module}.".startswith("tests.support.")
            ]
    assert not found, "\n".join(found)


#: What imports from the folder of a technique: the table of slots, plugins, and nobody else.
_TABLE = ("bases", "slots")


def _techniques() -> list[str]:
    return [path.parent.name for path in sorted((PACKAGE / "techniques").glob("*/__init__.py"))]


@pytest.mark.parametrize("technique", _techniques())
def test_a_technique_is_imported_by_the_table_and_its_plugins_only(technique: str) -> None:
    imported = ("techniques", technique)
    found = [
        file.relative_to(ROOT)
        for file, package in _files(PACKAGE)
        if file.relative_to(PACKAGE).parts[:2] != imported
        and file.relative_to(PACKAGE).with_suffix("").parts != _TABLE
        for module in _imports(file, package)
        if module[:2] == imported
    ]
    assert not found


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def test_nobody_asks_for_the_class_of_a_technique() -> None:
    """Neither a technique nor its learner, outside of its own folder."""
    homes: dict[str, Path] = {}
    for file, _package in _files(PACKAGE / "techniques"):
        for node in _tree(file).body:
            if isinstance(node, ast.ClassDef):
                homes[node.name] = file.parent
    found = []
    for folder in (PACKAGE, *(ROOT / plugins for plugins in PLUGINS)):
        for file in sorted(folder.rglob("*.py")):
            for node in ast.walk(_tree(file)):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
                    kinds = _names(node.args[1]) & set(homes)
                    if any(homes[kind] not in file.parents for kind in kinds):
                        found.append(f"{file.relative_to(ROOT)}:{node.lineno}")
    assert len(homes) > 50 and not found


def test_thresholds_of_efficiency_and_costs_are_those_of_the_planner() -> None:
    """What is compared with a gain, an efficiency or a cost has its name from ``planning``."""
    measure = re.compile(r"(gain|efficiency|cost)s?\b")
    found = []
    for file, _package in _files(PACKAGE):
        if "planning" in file.relative_to(PACKAGE).parts:
            continue
        tree = _tree(file)
        own = {
            target.id
            for node in tree.body if isinstance(node, ast.Assign)
            for target in ast.walk(node.targets[0])
            if isinstance(target, ast.Name) and target.id.strip("_").isupper()
        }  # fmt: skip
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and _names(node) & own:
                if measure.search(ast.unparse(node).lower()):
                    found.append(f"{file.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}")
    assert not found, "\n".join(found)
