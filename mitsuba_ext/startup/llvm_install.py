"""Installs the libraries that Dr.Jit's LLVM backend needs, or prints a command that installs them.

This module needs only the standard library, and is also a script::

    python -m mitsuba_ext.startup.llvm_install           # list the libraries found, and faults
    python -m mitsuba_ext.startup.llvm_install --ensure  # exit 0 if one works; else install one
"""

from __future__ import annotations

import argparse
import ctypes
import os
import re
import shutil
import subprocess
import sys

from . import llvm
from .llvm import NEWEST_TESTED, OLDEST, VARIABLE, Library, candidates, cpu_fault, fault, probe

#: A library to which Dr.Jit's wheel links and that minimal systems lack (drjit issue 484), and its
#: package.
_SYSTEM_LIBRARY, _SYSTEM_PACKAGE = "libatomic.so.1", "libatomic1"


def offered_packages() -> list[str]:
    """The packages of usable LLVM libraries that apt offers, newest first."""
    if not shutil.which("apt-cache"):
        return []
    command = ["apt-cache", "search", "--names-only", "^libllvm[0-9]+(t64)?$"]
    text = subprocess.run(command, capture_output=True, text=True).stdout
    found = {int(major): name for name, major in re.findall(r"^(libllvm(\d+)\S*)", text, re.M)}
    majors = [major for major in found if OLDEST <= major <= NEWEST_TESTED]
    return [found[major] for major in sorted(majors, reverse=True)]


def lacks_system_library() -> bool:
    """Whether libatomic is missing, without which Dr.Jit's wheel cannot be imported."""
    if sys.platform != "linux":
        return False
    try:
        ctypes.CDLL(_SYSTEM_LIBRARY)
    except OSError:
        return True
    return False


def install_command(with_llvm: bool = True) -> str:
    """Tells the user how to install the missing libraries; commands are quoted with backticks."""
    needed = [_SYSTEM_PACKAGE] if lacks_system_library() else []
    if shutil.which("apt-get"):
        if with_llvm:
            needed.append(next(iter(offered_packages()), "libllvm19"))
        return f"run `sudo apt install {' '.join(needed)}`"
    if sys.platform == "darwin":
        return "run `brew install llvm`"
    if with_llvm:
        needed.append(f"LLVM {OLDEST} or newer")
    return f"install {' and '.join(needed)} with your package manager"


def _as_root() -> list[str] | None:
    """The prefix of a command that needs root; ``None`` if this process cannot become root."""
    if os.geteuid() == 0:
        return []
    if not shutil.which("sudo"):
        return None
    if subprocess.run(["sudo", "-n", "true"], stderr=subprocess.DEVNULL).returncode == 0:
        return ["sudo", "-n"]
    return ["sudo"] if sys.stdin.isatty() else None


def ensure() -> Library | None:
    """Finds a library that passes the probe; if none does, installs one with apt.

    Returns:
        The library that ``import mitsuba_ext`` will use; ``None`` if there is still none.
    """
    works = _newest_that_works()
    if works or os.environ.get(VARIABLE) or cpu_fault() or not shutil.which("apt-get"):
        return works
    root = _as_root()
    if root is None:
        return None
    apt = [*root, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-y", "-qq"]
    print("Installing the libraries that Dr.Jit needs, with apt.", file=sys.stderr)
    subprocess.run([*apt, "update"], stdout=sys.stderr)
    first = [_SYSTEM_PACKAGE] if lacks_system_library() else []
    for package in first + offered_packages():
        subprocess.run([*apt, "install", "--no-install-recommends", package], stdout=sys.stderr)
        llvm._loader_cache.cache_clear()
        works = _newest_that_works()
        if works:
            return works
    return None


def _newest_that_works() -> Library | None:
    if lacks_system_library():
        return None
    wish = os.environ.get(VARIABLE)  # a choice of the user is not replaced
    libraries = [llvm.default_library()] if wish else candidates()
    usable = (library for library in libraries if not fault(library))
    return next((library for library in usable if not probe(library)), None)


def _advice() -> str:
    """Says, in one sentence, what to do if no library works and :func:`ensure` installed none."""
    if cpu_fault():
        return f"Dr.Jit cannot compile for this CPU: {cpu_fault()}."
    if os.environ.get(VARIABLE):
        library = llvm.default_library()
        reason = library and (fault(library) or probe(library))
        return f"{VARIABLE} names {library}, which {reason}: unset {VARIABLE}."
    if llvm.usable_library() and lacks_system_library():
        command = install_command(with_llvm=False)
        return f"Dr.Jit needs {_SYSTEM_LIBRARY}, which is missing: {command} and try again."
    libraries = candidates()
    reason = "there is none"
    if libraries:
        reason = f"{libraries[0]} {fault(libraries[0]) or probe(libraries[0])}"
    return f"No usable LLVM library was found ({reason}): {install_command()} and try again."


def main() -> int:
    parser = argparse.ArgumentParser(description="LLVM libraries for Dr.Jit")
    parser.add_argument("--ensure", action="store_true", help="install one with apt if none works")
    if parser.parse_args().ensure:
        library = ensure()
        if library is None:
            print(_advice(), file=sys.stderr)
        return 0 if library else 1
    default = llvm.default_library()
    for library in candidates():
        mark = "  <- Dr.Jit's own choice" if library == default else ""
        print(f"{library}: {fault(library) or 'usable'}{mark}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
