"""What the wheel holds, and that it works where the source tree is not at hand."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest
from conftest import SCENE

import mitsuba_ext
from mitsuba_ext import runtime

ROOT = Path(__file__).parents[1]
PYPROJECT = (ROOT / "pyproject.toml").read_text()
SOURCES = [ROOT / name for name in ("mitsuba_ext", "integrators", "emitters", "bsdfs", "shapes")]


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {file.parent for source in SOURCES for file in source.rglob("*.py")}
    lacking = [folder for folder in folders if not (folder / "__init__.py").exists()]
    assert not lacking, "setup.py leaves folders without __init__.py out of the wheel"


def test_range_of_mitsuba_is_the_same_in_both_places() -> None:
    first, end = (".".join(map(str, version)) for version in runtime.MITSUBA_VERSIONS)
    assert f'"mitsuba>={first},<{end}"' in PYPROJECT


def test_imports_at_module_level_are_declared() -> None:
    declared = set(re.findall(r'^    "([A-Za-z0-9_]+)[<>=]', PYPROJECT, re.MULTILINE))
    allowed = declared | set(_standard_library()) | {"drjit", "mitsuba_ext", "PIL"}
    for source in SOURCES:
        for file in source.rglob("*.py"):
            undeclared = _imports(file) - allowed
            assert not undeclared, f"{file} imports {undeclared}: add it to pyproject.toml"


def _imports(file: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(str(node.module).split(".")[0])
    return names


def _standard_library() -> frozenset[str]:
    if sys.version_info < (3, 10):
        pytest.skip("this Python does not list its standard library")
    return sys.stdlib_module_names


def test_type_hints_are_announced() -> None:
    assert (Path(inspect.getfile(mitsuba_ext)).parent / "py.typed").exists()


def test_plugin_folders_are_part_of_the_package_and_keep_their_sources() -> None:
    for kind in ("integrators", "emitters", "bsdfs", "shapes"):
        module = importlib.util.find_spec(f"mitsuba_ext.{kind}")
        assert module is not None
        assert module.origin is not None
        assert Path(module.origin).parent.name == kind


@pytest.mark.slow
def test_wheel_works_in_another_environment(tmp_path: Path) -> None:
    """Built from the tree, installed elsewhere: the plugins are registered and render, and a
    comparison writes its report."""
    tree = tmp_path / "tree"  # a copy: setuptools reuses what an earlier build left in build/
    for source in SOURCES:
        shutil.copytree(source, tree / source.name)
    for name in ("pyproject.toml", "setup.py", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(tree)]
    subprocess.run(command, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([str(python), "-m", "pip", "install", "--quiet", str(wheel)], check=True)
    code = """
import inspect, pathlib, sys
import mitsuba_ext
from mitsuba_ext import doctor, registry
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
assert pathlib.Path(inspect.getfile(mitsuba_ext)).is_relative_to(sys.prefix)
assert "mitsuba_ext" in inspect.getsource(registry)
assert any(registry.plugin_names().values())
sys.exit(doctor.main())
"""
    subprocess.run([str(python), "-c", code], cwd=tmp_path, check=True)
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator="", film="", body=""))
    arguments = ["compare", scene, "path", "--spp=2", "--seeds=1", "--reference-spp=8", "--out=out"]
    subprocess.run([python, "-m", "mitsuba_ext.cli", *arguments], cwd=tmp_path, check=True)
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
