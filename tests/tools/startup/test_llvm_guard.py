"""An LLVM library that does not work is replaced silently if possible; else an error names it.

The libraries here are fakes: another shared library under LLVM's name. Whatever depends on the
moment at which Dr.Jit loads one runs in a process of its own.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from mitsuba_ext.startup import llvm, llvm_install, runtime
from mitsuba_ext.util.errors import InstallationError
from tests.support.paths import ROOT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the fakes are ELF files")


@pytest.fixture
def fake(tmp_path: Path) -> Path:
    """A library called LLVM 14, and a link ``libLLVM.so`` to it for the loader's search path."""
    with open("/proc/self/maps") as maps:
        some_library = next(line.split()[-1] for line in maps if "/libc.so" in line)
    path = tmp_path / "libLLVM-14.so.1"
    shutil.copy(some_library, path)
    (tmp_path / "libLLVM.so").symlink_to(path.name)
    return path


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    clean = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**clean, **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )


PRINT_CHECK = """
for variant in ("cuda_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
    try:
        runtime.check(variant)
        print(variant, "passes")
    except RuntimeError as error:
        print(error)
"""


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", (15,)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", (19, 1)),
        ("/usr/lib/llvm-19/lib/libLLVM.so", (19,)),
        ("/usr/lib/llvm-19/lib/libLLVM.so.1", (19,)),
        ("/opt/homebrew/Cellar/llvm@18/18.1.8/lib/libLLVM.dylib", (18, 1, 8)),
        ("/somewhere/libLLVM.so", ()),
    ],
)
def test_version_is_read_from_the_name(path: str, version: tuple[int, ...]) -> None:
    assert llvm._version_in_name(path) == version


def test_version_is_read_behind_links(fake: Path) -> None:
    assert llvm.Library.at(str(fake.with_name("libLLVM.so"))) == llvm.Library(str(fake), (14,))


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the rule for x86")
def test_versions_that_cannot_compile_a_minimum_on_x86_are_refused() -> None:
    assert "LLVM 17 or newer" in llvm.version_fault((14,))
    assert "minimum" in llvm.version_fault((15,))
    assert "minimum" in llvm.version_fault((16, 0, 6))
    assert llvm.version_fault((17,)) == llvm.version_fault((19, 1)) == llvm.version_fault(()) == ""


def test_files_that_are_no_library_are_refused(tmp_path: Path) -> None:
    script = tmp_path / "libLLVM-19.so"
    script.write_text("INPUT(libLLVM.so.19.1)")
    assert llvm.fault(llvm.Library.at(str(script))) == "is not a shared library"
    missing = llvm.Library.at(str(tmp_path / "libLLVM-20.so"))
    assert llvm.fault(missing) == "cannot be opened (No such file or directory)"


def test_probe_survives_a_broken_library_and_is_remembered(
    fake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    nameless = fake.rename(tmp_path / "libLLVM-private.so")
    library = llvm.Library.at(str(nameless))
    assert library.version == ()
    verdict = llvm.fault(library)
    assert "small kernel" in verdict
    monkeypatch.setattr(subprocess, "run", None)
    assert llvm.fault(library) == verdict


def test_failed_probe_overrules_the_version(
    fake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    library = llvm.Library.at(str(fake.rename(tmp_path / "libLLVM.so.19.1")))
    assert llvm.fault(library) == ""
    assert llvm.probe(library) != ""
    assert llvm.fault(library) == llvm.probe(library)


def test_usable_library_is_chosen_silently(fake: Path) -> None:
    code = f"""
import os, mitsuba_ext, drjit
from mitsuba_ext.startup import llvm, runtime
runtime.check("llvm_ad_rgb")
print(os.environ["{llvm.VARIABLE}"] == runtime.loaded_library().path)
print(drjit.detail.llvm_version()[0] >= llvm.OLDEST)
"""
    process = run(code, LD_LIBRARY_PATH=str(fake.parent))
    assert (process.stdout, process.stderr) == ("True\nTrue\n", "")


def test_working_default_is_left_alone() -> None:
    default = llvm.default_library()
    if default is None or llvm.fault(default):
        pytest.skip("Dr.Jit's own choice does not work on this machine")
    code = f'import os, mitsuba_ext; print(os.environ.get("{llvm.VARIABLE}"))'
    assert run(code).stdout == "None\n"


def test_choice_of_the_user_is_respected_and_refused_by_name(fake: Path) -> None:
    code = f"""
import os, mitsuba_ext
from mitsuba_ext.startup import runtime
print(os.environ["{llvm.VARIABLE}"])
{PRINT_CHECK}
"""
    lines = run(code, **{llvm.VARIABLE: str(fake)}).stdout.splitlines()
    assert lines[:3] == [str(fake), "cuda_ad_rgb passes", "scalar_rgb passes"]
    for part in ("llvm_ad_rgb: Dr.Jit", f"LLVM 14 ({fake})", "too old", f"unset {llvm.VARIABLE}"):
        assert part in lines[3]


def test_path_that_does_not_exist_is_refused_by_name() -> None:
    code = f"import mitsuba_ext\nfrom mitsuba_ext.startup import runtime\n{PRINT_CHECK}"
    process = run(code, **{llvm.VARIABLE: "/nowhere/libLLVM.so"})
    assert "/nowhere/libLLVM.so), which cannot be opened" in process.stdout


def test_mitsuba_imported_first_says_to_import_us_before(fake: Path) -> None:
    code = f"import mitsuba, mitsuba_ext\nfrom mitsuba_ext.startup import runtime\n{PRINT_CHECK}"
    process = run(code, LD_LIBRARY_PATH=str(fake.parent))
    assert "import mitsuba_ext before mitsuba" in process.stdout.splitlines()[2]


def test_set_variant_raises_our_sentence_where_drjit_refused_the_library(fake: Path) -> None:
    code = """
import mitsuba_ext, mitsuba as mi
from mitsuba_ext.startup import runtime
runtime.guard(mi)
mi.set_variant("scalar_rgb")
try:
    mi.set_variant("llvm_ad_rgb")
except RuntimeError as error:
    print(error)
"""
    assert "too old" in run(code, **{llvm.VARIABLE: str(fake)}).stdout


@pytest.mark.parametrize("major", [15, 16])
@pytest.mark.skipif(platform.machine() != "x86_64", reason="these work elsewhere")
def test_real_library_that_aborts_is_recognised_before_the_first_kernel(major: int) -> None:
    found = [library for library in llvm.candidates() if library.version[:1] == (major,)]
    if not found:
        pytest.skip(f"LLVM {major} is not installed")
    code = """
import mitsuba_ext, mitsuba as mi
try:
    mi.set_variant("llvm_ad_rgb")
except RuntimeError as error:
    print(error)
"""
    output = run(code, **{llvm.VARIABLE: found[0].path}).stdout
    assert f"Dr.Jit loaded LLVM {major}." in output
    assert "takes a minimum" in output


def test_remedy_is_a_package_where_no_usable_library_exists(
    fake: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: [llvm.Library.at(str(fake))])
    monkeypatch.setattr(llvm_install, "lacks_system_library", lambda: False)
    monkeypatch.setattr(shutil, "which", lambda name, path=None: "/usr/bin/" + name)
    monkeypatch.setattr(llvm_install, "offered_packages", lambda: ["libllvm19"])
    assert runtime._remedy(None, loaded=True) == "run `sudo apt install libllvm19`"


def test_missing_system_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm_install, "lacks_system_library", lambda: True)
    with pytest.raises(InstallationError, match=r"libatomic\.so\.1 is missing.*libatomic"):
        with runtime.missing_library_is_named():
            raise NameError("name '_drjit_ext' is not defined")  # what Dr.Jit 1.5 raises


def test_probe_that_cannot_import_drjit_says_nothing_about_the_library(
    fake: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "drjit").mkdir()
    (tmp_path / "drjit" / "__init__.py").write_text("import nothing_of_this_name")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert "Dr.Jit cannot be imported" in llvm.probe(llvm.Library.at(str(fake)))
    assert not (tmp_path / "cache").exists()


def test_ensure_without_a_usable_library_is_one_sentence(fake: Path) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "mitsuba_ext.startup.llvm_install", "--ensure"],
        env={**os.environ, llvm.VARIABLE: str(fake)},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 1
    assert process.stderr.count("\n") == 1
    assert str(fake) in process.stderr


@pytest.mark.parametrize(
    "version", ["3.8.0", "3.9.0", "3.10.0", "3.10rc1", "3.10.0rc1", "3.10.0.dev2+g1234", "4.0.1"]
)
def test_other_versions_of_mitsuba_are_refused(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "version", lambda _: version)
    with pytest.raises(InstallationError, match=rf"{re.escape(version)} is installed: run `pip"):
        runtime.check_installed_version()


@pytest.mark.parametrize("version", ["3.9.1", "3.9.12", "3.9.1.dev0", "3.9.2rc1"])
def test_our_versions_of_mitsuba_are_accepted(
    version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "version", lambda _: version)
    runtime.check_installed_version()


def test_development_build_with_other_meshes_is_refused() -> None:
    class Mesh:
        """A mesh of Mitsuba 3.10; builds of it called themselves 3.9.1."""

        def positions(self) -> None: ...

    with pytest.raises(InstallationError, match=r"3\.10, but a development build"):
        runtime.check_meshes(Mesh)


@pytest.mark.parametrize("command", ["render", "compare"])
def test_other_version_of_mitsuba_is_one_sentence_on_the_command_line(
    command: str, run, make_scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metadata, "version", lambda _: "3.10.0")
    monkeypatch.delitem(sys.modules, "mitsuba")  # as if nothing had imported it yet
    options = {"render": ["-o", tmp_path / "image.exr"], "compare": ["path", "--spp", "1"]}
    code, out, err = run(command, make_scene(), *options[command])
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert 'but 3.10.0 is installed: run `pip install "mitsuba>=3.9.1,<3.10"`' in err
