"""Finds the LLVM library that Dr.Jit would load, and others, and checks whether they work.

Dr.Jit loads libLLVM when it is imported. An unusable library crashes at the first kernel instead of
raising an exception, so a library has to be chosen beforehand. :mod:`.llvm_install` installs one.
"""

from __future__ import annotations

import glob
import json
import os
import platform
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

#: The environment variable that overrides Dr.Jit's own search.
VARIABLE = "DRJIT_LIBLLVM_PATH"

#: The oldest usable version. Dr.Jit 1.5 refuses older libraries. On x86, LLVM 15 and 16 cannot
#: compile ``llvm.minimum`` and ``llvm.maximum`` (llvm-project issue 53353), whether or not the CPU
#: has AVX-512.
OLDEST = 17 if platform.machine().lower() in ("x86_64", "amd64") else 15

#: The newest version that does not have to pass :func:`probe`.
NEWEST_TESTED = 22

#: The places that Dr.Jit 1.5 searches if the loader finds no ``libLLVM.so`` (src/llvm_api.cpp).
_DRJIT_GLOBS = {
    "linux": [
        f"/usr/lib/{folder}/libLLVM*.so.*"
        for folder in ("x86_64-linux-gnu", "aarch64-linux-gnu", "wsl/lib")
    ],
    "darwin": [
        ("/opt/homebrew" if platform.machine() == "arm64" else "/usr/local")
        + "/Cellar/llvm/*/lib/libLLVM.dylib"
    ],
}

#: Other places where libraries are installed.
_OTHER_GLOBS = {
    "linux": [
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/local/lib/libLLVM*.so*",
        f"{sys.prefix}/lib/libLLVM*.so*",
    ],
    "darwin": [
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
        f"{sys.prefix}/lib/libLLVM*.dylib",
    ],
}

_ELF_MACHINES = {"x86_64": 62, "aarch64": 183}

# The literal ``scale`` differs each time; otherwise Dr.Jit could load the kernel from its disk
# cache, compiled by another library.
_PROBE = """
import sys
try:
    import drjit as dr
    from drjit.llvm import Float
except Exception as error:
    print(error.__context__ or error, file=sys.stderr)
    sys.exit(3)
scale = float(sys.argv[1])
x = dr.opaque(Float, 1, 64) * dr.arange(Float, 64)
y = dr.maximum(dr.minimum(x * scale, 40 * scale), 10 * scale) / scale
ok = dr.allclose([y[0], y[20], y[63]], [10, 20, 40], rtol=1e-4)
sys.exit(0 if ok else "wrong numbers")
"""


@dataclass(frozen=True)
class Library:
    """An LLVM library file.

    Attributes:
        path: The file with links resolved, or the user's text if the file does not exist; empty for
            a library in this process whose file is unknown.
        version: The version in the file's name, e.g. ``(19, 1)``; empty if there is none.
    """

    path: str
    version: tuple[int, ...] = ()

    @classmethod
    def at(cls, path: str) -> Library:
        """The library at ``path``, with the version in the resolved file's name."""
        resolved = os.path.realpath(path) if os.path.exists(path) else path
        return cls(resolved, _version_in_name(resolved) or _version_in_name(path))

    def __str__(self) -> str:
        version = ".".join(map(str, self.version)) or "of unknown version"
        return f"LLVM {version} ({self.path or 'file unknown'})"


def _version_in_name(path: str) -> tuple[int, ...]:
    patterns = (
        r"libLLVM-(\d+(?:\.\d+)*)\.(?:so|dylib)",  # libLLVM-15.so.1
        r"libLLVM\.so\.(\d\d+(?:\.\d+)*)$",  # libLLVM.so.19.1
        r"/Cellar/llvm(?:@\d+)?/(\d+(?:\.\d+)*)",  # Homebrew
        r"/llvm-(\d+)/lib/",  # /usr/lib/llvm-19/lib/libLLVM.so
    )
    for pattern in patterns:
        match = re.search(pattern, path)
        if match:
            return tuple(map(int, match[1].split(".")))
    return ()


# ---------------------------------------------------------------- Libraries on this machine


@cache
def _loader_cache() -> tuple[tuple[str, str], ...]:
    """The dynamic loader's table of LLVM libraries, as pairs of name and path."""
    ldconfig = shutil.which("ldconfig", path=os.environ.get("PATH", "") + ":/sbin:/usr/sbin")
    if sys.platform != "linux" or ldconfig is None:
        return ()
    table = subprocess.run([ldconfig, "-p"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    lines = table.stdout.decode(errors="replace").splitlines()
    return tuple(
        (line.split()[0], line.rsplit("=> ", 1)[1])
        for line in lines
        if "=> " in line and line.lstrip().startswith("libLLVM")
    )


def _find_as_loader(name: str) -> str | None:
    """The file that ``dlopen(name)`` would open."""
    if "/" in name:
        return name if os.path.exists(name) else None
    folders = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    paths = [os.path.join(folder, name) for folder in folders if folder]
    paths += [path for cached, path in _loader_cache() if cached == name]
    paths += [os.path.join(folder, name) for folder in ("/lib", "/usr/lib", "/lib64", "/usr/lib64")]
    return next((path for path in paths if not _why_not_loadable(path)), None)


def _natural_order(path: str) -> list[object]:
    """A sorting key that compares runs of digits as numbers, as Dr.Jit does."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path)]


def default_library() -> Library | None:
    """The library that Dr.Jit's own search finds; ``None`` if it finds none."""
    wish = os.environ.get(VARIABLE)
    if wish:
        return Library.at(_find_as_loader(wish) or wish)
    found = _find_as_loader("libLLVM.dylib" if sys.platform == "darwin" else "libLLVM.so")
    if found is None:
        paths = [p for pattern in _DRJIT_GLOBS.get(sys.platform, []) for p in glob.glob(pattern)]
        paths.sort(key=_natural_order)
        files = [path for path in paths if not os.path.islink(path)]
        found = next(reversed(files or paths), None)
    return Library.at(found) if found else None


def candidates() -> list[Library]:
    """Every LLVM library found on this machine, newest first."""
    libraries = {library.path: library for library in map(Library.at, _candidate_paths())}
    return sorted(libraries.values(), key=lambda library: library.version, reverse=True)


def _candidate_paths() -> Iterator[str]:
    wish = os.environ.get(VARIABLE)
    if wish:
        yield _find_as_loader(wish) or wish
    for pattern in _DRJIT_GLOBS.get(sys.platform, []) + _OTHER_GLOBS.get(sys.platform, []):
        # libLLVM.so, libLLVM-19.so.1; not libLLVMSupport.so
        yield from (p for p in glob.glob(pattern) if re.search(r"/libLLVM(-\d|\.(so|dylib))", p))
    for _, path in _loader_cache():
        yield path
    for folder in os.environ.get("LD_LIBRARY_PATH", "").split(":"):
        if folder:
            yield from glob.glob(os.path.join(folder, "libLLVM.so*"))


@cache
def cpu() -> tuple[str, frozenset[str]]:
    """The CPU's name and its feature flags; no flags if they cannot be read."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine(), frozenset()
    entries = dict(re.findall(r"^(model name|flags|Features)\s*:\s*(.*)$", text, re.MULTILINE))
    flags = entries.get("flags", entries.get("Features", ""))
    return entries.get("model name", platform.machine()), frozenset(flags.split())


# ---------------------------------------------------------------- Usability


def fault(library: Library) -> str:
    """Why Dr.Jit cannot use ``library``, as the end of a sentence about it; empty if it can.

    Old versions are refused. For others, the stored result of a probe decides, if there is one. An
    unknown version, or one newer than :data:`NEWEST_TESTED`, is probed now.
    """
    problem = version_fault(library.version)
    if problem or not library.path:
        return problem
    problem = _why_not_loadable(library.path)
    if problem:
        return problem
    known = _read_cache().get(_cache_key(library))
    if known is not None:
        return known
    if not library.version or library.version[0] > NEWEST_TESTED:
        return probe(library)
    return ""


def version_fault(version: tuple[int, ...]) -> str:
    """Why Dr.Jit cannot use this version on this machine; empty if it can, or if unknown."""
    if version and version[0] < 15:
        return f"is too old: Dr.Jit needs LLVM {OLDEST} or newer on this machine"
    if version and version[0] < OLDEST:
        return (
            "ends the process at the first kernel that takes a minimum or maximum: "
            f"Dr.Jit needs LLVM {OLDEST} or newer on x86"
        )
    return ""


def cpu_fault() -> str:
    """Why no LLVM library works on this CPU; empty if one may work."""
    flags = cpu()[1]
    if platform.machine() == "x86_64" and flags and "fma" not in flags:
        return "this CPU lacks the FMA instructions, which Dr.Jit's LLVM backend needs"
    return ""


def _why_not_loadable(path: str) -> str:
    try:
        with open(path, "rb") as file:
            header = file.read(20)
    except OSError as error:
        return f"cannot be opened ({error.strerror})"
    if sys.platform == "linux":
        machine = _ELF_MACHINES.get(platform.machine())
        if len(header) < 20 or header[:4] != b"\x7fELF":
            return "is not a shared library"
        if machine and int.from_bytes(header[18:20], "little") != machine:
            return f"is not a library for {platform.machine()}"
    return ""


def usable_library() -> Library | None:
    """The newest library that Dr.Jit can use; ``None`` if there is none."""
    return next((library for library in candidates() if not fault(library)), None)


def probe(library: Library) -> str:
    """Runs a small kernel with ``library`` in another process, and stores the result in a file.

    Returns:
        An empty string if the kernel returned the right numbers; otherwise the reason, as in
        :func:`fault`.
    """
    key, verdicts = _cache_key(library), _read_cache()
    if key in verdicts:
        return verdicts[key]
    environment = {**os.environ, VARIABLE: library.path}
    command = [sys.executable, "-c", _PROBE, repr(1 + random.random())]
    try:
        run = subprocess.run(command, env=environment, cwd="/", capture_output=True, timeout=120)
    except subprocess.TimeoutExpired:
        # Not stored, because the machine may be busy
        return "did not compile a small kernel within two minutes"
    lines = run.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
    if run.returncode == 3:  # not the fault of the library, so not stored
        return f"cannot be tried, because Dr.Jit cannot be imported ({lines[-1][:160]})"
    verdict = ""
    if run.returncode < 0:
        message = next((line for line in lines if "LLVM ERROR" in line), lines[0])
        name = signal.Signals(-run.returncode).name
        verdict = f"ends the process at a small kernel ({name}: {message[:60]})"
    elif run.returncode > 0:
        verdict = f"does not run a small kernel ({lines[-1][:160]})"
    _write_cache({**verdicts, key: verdict})
    return verdict


def _cache_file() -> Path:
    home = Path.home()
    folder = home / "Library/Caches" if sys.platform == "darwin" else home / ".cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or folder) / "mitsuba_ext" / "llvm.json"


def _cache_key(library: Library) -> str:
    try:
        drjit = metadata.version("drjit")
    except metadata.PackageNotFoundError:
        drjit = "?"
    stat = os.stat(library.path)
    return f"{library.path}|{stat.st_mtime_ns}|{stat.st_size}|drjit {drjit}|{cpu()[0]}"


def _read_cache() -> dict[str, str]:
    try:
        verdicts = json.loads(_cache_file().read_text())
    except (OSError, RuntimeError, ValueError):  # RuntimeError: no home folder
        return {}
    return verdicts if isinstance(verdicts, dict) else {}


def _write_cache(verdicts: dict[str, str]) -> None:
    try:
        file = _cache_file()
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_name(f"{file.name}.{os.getpid()}")
        partial.write_text(json.dumps(verdicts, indent=1))
        partial.replace(file)
    except (OSError, RuntimeError):
        pass  # without the cache, the probe runs again next time
