"""The content of the wheel, which works without the source tree."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import mitsuba_ext
from mitsuba_ext.startup import runtime
from tests.support.command_line import SCENE
from tests.support.paths import ROOT

PYPROJECT = (ROOT / "pyproject.toml").read_text()
KINDS = ("integrators", "emitters", "bsdfs", "samplers", "sensors", "shapes")
SOURCES = [ROOT / name for name in ("mitsuba_ext", *KINDS)]


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {file.parent for source in SOURCES for file in source.rglob("*.py")}
    lacking = [folder for folder in folders if not (folder / "__init__.py").exists()]
    assert not lacking, "setup.py leaves folders without __init__.py out of the wheel"


def test_range_of_mitsuba_is_the_same_in_both_places() -> None:
    first, end = (".".join(map(str, version)) for version in runtime.MITSUBA_VERSIONS)
    assert f'"mitsuba>={first},<{end}"' in PYPROJECT


def test_the_changes_and_the_citation_name_the_version() -> None:
    """The version stands in ``mitsuba_ext.__version__``; these two files repeat it."""
    entries = re.findall(
        r"^## \[(.+?)\] – (.+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.findall(r"^version: (.+)$", citation, re.MULTILINE)
    date = re.findall(r'^date-released: "(.+)"$', citation, re.MULTILINE)
    assert entries[0] == (mitsuba_ext.__version__, *date)
    assert version == [mitsuba_ext.__version__]
    attribute = r'^version = \{ attr = "mitsuba_ext.util.version.__version__" \}$'
    assert re.search(attribute, PYPROJECT, re.MULTILINE)


def test_authors_and_keywords_agree_with_the_citation() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    names = re.findall(r"^  - name: (.+)$", citation, re.MULTILINE)
    keywords = re.search(r"^keywords:\n((?:  - .+\n?)+)", citation, re.MULTILINE)[1]
    authors = ", ".join(f'{{ name = "{name}" }}' for name in names)
    assert names and f"\nauthors = [{authors}]\n" in PYPROJECT
    words = ", ".join(f'"{line[4:]}"' for line in keywords.splitlines())
    assert f"\nkeywords = [{words}]\n" in PYPROJECT


def test_internal_names_are_not_listed() -> None:
    public = [name for name in dir(mitsuba_ext) if not name.startswith("__")]
    assert public == ["compare", "replay", "scene_description"] and mitsuba_ext.compare.Comparison


def test_workflow_of_github_runs_the_steps_of_the_ci() -> None:
    yaml = pytest.importorskip("yaml")
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    workflow = yaml.safe_load(text)
    # YAML 1.1 reads the key "on" as true
    assert {"push", "pull_request"} <= set(workflow[True])
    (job,) = workflow["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == ["3.9", "3.12"]
    assert all("uses" in step or "run" in step for step in job["steps"])
    commands = "\n".join(step.get("run", "") for step in job["steps"])
    for command in (".ci/run", "-m build"):
        assert command in commands, f"ci.yml does not run {command}"


def test_page_on_versions_names_every_file_that_uses_meshes_as_in_mitsuba_3_9() -> None:
    old = r"vertex_(?:positions|normals|texcoords)|faces_buffer|has_vertex_normals|mi\.Mesh\("
    files = [file for source in SOURCES for file in source.rglob("*.py")]
    using = {str(file.relative_to(ROOT)) for file in files if re.search(old, file.read_text())}
    page = (ROOT / "docs" / "mitsuba_versions.md").read_text()
    named = set(re.findall(r"`((?:mitsuba_ext|shapes|tests)/[\w/]+\.py)`", page))
    assert using <= named, f"add {using - named} to docs/mitsuba_versions.md"
    assert all((ROOT / name).is_file() for name in named)


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
    for kind in KINDS:
        module = importlib.util.find_spec(f"mitsuba_ext.{kind}")
        assert module is not None
        assert module.origin is not None
        assert Path(module.origin).parent.name == kind


@pytest.fixture
def source_tree(tmp_path: Path) -> Path:
    """A copy of the source tree, as a clone or a zip archive has it."""
    tree = tmp_path / "tree"
    for source in SOURCES:
        shutil.copytree(source, tree / source.name)
    return tree


def test_other_processes_run_the_package_of_their_parent(source_tree: Path, tmp_path: Path) -> None:
    """It runs the package of the installed command, and not one in the current folder."""
    packages = tmp_path / "packages"
    shutil.copytree(SOURCES[0], packages / "mitsuba_ext")
    for source in SOURCES[1:]:
        shutil.copytree(source, packages / "mitsuba_ext" / source.name)
    (packages / "worker.py").write_text("""
import importlib.util, sys
print(__name__, sys.argv[1:], importlib.util.find_spec("mitsuba_ext.integrators.neepp").origin)
""")
    command = tmp_path / "command"
    command.write_text("""
import pathlib, subprocess, sys
from mitsuba_ext.startup.processes import python_command
sys.path.append(pathlib.Path("added by a user"))
subprocess.run(python_command("worker", "1 + 1", "'"))
""")
    result = _run(source_tree, command, PYTHONPATH=str(packages))
    plugin = packages / "mitsuba_ext" / "integrators" / "neepp.py"
    assert result.stdout == f"""__main__ ['1 + 1', "'"] {plugin}\n""", result.stderr


def test_no_process_imports_files_of_the_current_folder() -> None:
    for file in SOURCES[0].rglob("*.py"):
        assert '"-m"' not in file.read_text(), f"{file}: use python_command"


def test_source_tree_that_is_not_installed_finds_its_plugins(source_tree: Path) -> None:
    code = """
import mitsuba_ext
from mitsuba_ext import cli
from mitsuba_ext.startup import plugin_folders
print(*plugin_folders.plugin_files("integrators"))
cli.main(["list"])
"""
    output = _run(source_tree, "-c", code).stdout
    assert str(source_tree / "integrators" / "neepp.py") in output
    assert "Next event estimation++" in output
    assert _run(source_tree, "-m", "mitsuba_ext", "--version").stdout.startswith("mitsuba-ext")


def test_package_inside_of_an_archive_is_refused(source_tree: Path, tmp_path: Path) -> None:
    archive = shutil.make_archive(str(tmp_path / "archive"), "zip", source_tree, "mitsuba_ext")
    result = _run(tmp_path, "-c", "import mitsuba_ext", PYTHONPATH=archive)
    assert result.returncode == 1 and "none of its plugins" in result.stderr.splitlines()[-1]


def _run(folder: Path, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


#: What is not part of the sources: git's own, environments, and what is built.
_BUILT = (
    ".git", ".venv", "out", "build", "dist", "_build", "*.egg-info", "__pycache__", ".*_cache",
)  # fmt: skip


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A copy of the whole tree, and the archive of its sources and the wheel made from that."""
    folder = tmp_path_factory.mktemp("built")
    tree = folder / "tree"
    shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*_BUILT))
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder, tree], check=True)
    (archive,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return tree, archive, wheel


@pytest.mark.slow
def test_the_archive_has_the_files_that_tests_and_docs_need(built: tuple[Path, Path, Path]) -> None:
    tree, archive, _ = built
    with tarfile.open(archive) as file:
        names = {name.partition("/")[2] for name in file.getnames()}
    assert archive.name == f"mitsuba_ext-{mitsuba_ext.__version__}.tar.gz"
    wanted = {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md"}
    wanted |= {".ci/run", ".github/workflows/ci.yml", "pyproject.toml", "setup.py"}
    for folder in ("benchmarks", "docs", "examples", "scenes", "tests", "mitsuba_ext", *KINDS):
        files = (file for file in (tree / folder).rglob("*") if file.is_file())
        wanted |= {str(file.relative_to(tree)) for file in files}
    wanted -= {f"scenes/{file.name}" for file in (tree / "scenes").glob("*_in_fog.xml")}
    assert not wanted - names, "MANIFEST.in leaves files out"
    assert not [name for name in names if name.endswith(".pyc")]


@pytest.mark.slow
def test_wheel_has_plugins_and_templates_and_nothing_else(built: tuple[Path, Path, Path]) -> None:
    tree, _, wheel = built
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    assert wheel.name == f"mitsuba_ext-{mitsuba_ext.__version__}-py3-none-any.whl"
    wanted = {"mitsuba_ext/py.typed"}
    for folder in ("mitsuba_ext", *KINDS):
        # The folders of plugins are inside of the installed package
        prefix = "" if folder == "mitsuba_ext" else "mitsuba_ext/"
        for file in (tree / folder).rglob("*"):
            if file.suffix in (".py", ".pyi", ".html", ".css", ".js"):
                wanted.add(prefix + str(file.relative_to(tree)))
    assert "mitsuba_ext/compare/report/report.css" in wanted
    info = f"mitsuba_ext-{mitsuba_ext.__version__}.dist-info/"
    assert {name for name in names if not name.startswith(info)} == wanted
    assert info + "licenses/LICENSE" in names
    with zipfile.ZipFile(wheel) as file:
        metadata = file.read(info + "METADATA").decode()
    assert "\nAuthor: The mitsuba_ext developers\n" in metadata
    assert "\nLicense-Expression: MIT\n" in metadata and "\nKeywords: rendering," in metadata


@pytest.mark.slow
def test_archive_and_wheel_work_in_another_environment(
    built: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    """Installed elsewhere, the plugins are registered and render, and a comparison writes its
    report, also where the source tree is the current folder."""
    tree, archive, wheel = built
    venv.create(tmp_path / "venv", with_pip=True)
    binaries = tmp_path / "venv" / "bin"
    code = """
import inspect, pathlib, sys
import mitsuba_ext
from mitsuba_ext.startup import doctor, plugin_folders, registry
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
assert pathlib.Path(inspect.getfile(mitsuba_ext)).is_relative_to(sys.prefix)
assert "mitsuba_ext" in inspect.getsource(registry)
assert any(plugin_folders.plugin_names().values())
sys.exit(doctor.main())
"""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.format(integrator="", film="", body=""))
    arguments = ["compare", scene, "path", "--spp=2", "--seeds=1", "--reference-spp=8"]
    for source in (wheel, archive):
        install = [binaries / "python", "-m", "pip", "install", "--quiet", "--force-reinstall"]
        options = [] if source == wheel else ["--no-deps"]
        subprocess.run([*install, *options, source], check=True)
        subprocess.run([binaries / "python", "-c", code], cwd=tmp_path, check=True)
        image = tmp_path / f"first{source.suffix}.exr"
        render = [binaries / "mitsuba-ext", "render", scene, "-o", image, "--spp=4"]
        subprocess.run(render, cwd=tmp_path, check=True)
        assert image.exists()
        out = tmp_path / source.suffix
        subprocess.run([binaries / "mitsuba-ext", *arguments, f"--out={out}"], cwd=tree, check=True)
        assert (out / "report.html").stat().st_size > 10_000
