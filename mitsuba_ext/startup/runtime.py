"""Checks Mitsuba's version and the LLVM library, so that unsuitable ones lead to a clear message.

``mitsuba_import.py`` calls these functions before and after the import of Dr.Jit and Mitsuba, and
``registry.py`` whenever a variant is selected.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from types import ModuleType

from ..util.errors import InstallationError
from . import llvm

#: The variants in which the plugins work.
SUPPORTED_VARIANTS: tuple[str, ...] = (
    "llvm_ad_rgb",
    "llvm_ad_mono",
    "llvm_ad_spectral",
    "cuda_ad_rgb",
    "cuda_ad_mono",
    "cuda_ad_spectral",
)

#: The supported versions of Mitsuba: from the first up to, but not including, the second (3.10
#: renames the parameters of meshes). ``pyproject.toml`` has the same range.
MITSUBA_VERSIONS = ((3, 9, 1), (3, 10))


def choose_llvm() -> None:
    """Chooses an LLVM library that works, before Dr.Jit is imported.

    Sets ``DRJIT_LIBLLVM_PATH`` if the user has not set it and the library that Dr.Jit would load
    does not work. A machine without a usable library is not an error here: CUDA variants need none,
    and :func:`check` refuses the others.
    """
    if sys.platform != "win32" and not os.environ.get(llvm.VARIABLE):
        default = llvm.default_library()
        if default is None or llvm.fault(default):
            usable = llvm.usable_library()
            if usable:
                os.environ[llvm.VARIABLE] = usable.path


@contextlib.contextmanager
def missing_library_is_named() -> Iterator[None]:
    """A context for the import of Dr.Jit that raises a clear error if a system library is missing.

    Raises:
        InstallationError: A library is missing; the message says how to install it.
    """
    try:
        yield
    except (ImportError, NameError) as error:  # NameError: a bug in Dr.Jit's own message
        from . import llvm_install

        if llvm_install.lacks_system_library():
            raise InstallationError(
                "Dr.Jit cannot be imported because libatomic.so.1 is missing. To fix this, "
                f"{llvm_install.install_command(with_llvm=llvm.usable_library() is None)}."
            ) from error
        raise


def check_installed_version() -> None:
    """Calls :func:`check_version`, if Mitsuba is an installed package."""
    with contextlib.suppress(metadata.PackageNotFoundError):  # built from source or missing
        check_version(metadata.version("mitsuba"))


def check_version(found: str) -> None:
    """Refuses unsupported versions of Mitsuba.

    Args:
        found: The version, such as ``"3.9.1"``. A pre-release counts as its release.

    Raises:
        InstallationError: The version is unsupported; the message names supported ones.
    """
    numbers = tuple(map(int, re.findall(r"\d+", found)[:3]))
    if not MITSUBA_VERSIONS[0] <= numbers < MITSUBA_VERSIONS[1]:
        raise _wrong_version(found)


def check_meshes(mesh: type) -> None:
    """Refuses development builds of Mitsuba 3.10, whose version number is 3.9.1.

    Args:
        mesh: The class ``mi.Mesh`` of the active variant.

    Raises:
        InstallationError: The version is unsupported; the message names supported ones.
    """
    if not hasattr(mesh, "vertex_positions_buffer"):
        raise _wrong_version("a development build of a later one")


def _wrong_version(found: str) -> InstallationError:
    first, end = (".".join(map(str, version)) for version in MITSUBA_VERSIONS)
    return InstallationError(
        f"mitsuba_ext works with Mitsuba from {first} up to, but not including, {end}, but "
        f'{found} is installed: run `pip install "mitsuba>={first},<{end}"`.'
    )


def check(variant: str) -> None:
    """Refuses an LLVM variant if Dr.Jit's LLVM library does not work.

    Args:
        variant: A name such as ``"llvm_ad_rgb"``. Variants that need no LLVM pass.

    Raises:
        InstallationError: The library does not work; the message says why, and the remedy.
    """
    if variant.startswith("llvm_"):
        problem = llvm_problem()
        if problem:
            raise InstallationError(f"{variant}: {problem}")


def ensure_two_threads() -> None:
    """Gives Dr.Jit a second thread on a machine with one core. With a single thread, Mitsuba 3.9.1
    deadlocks when it reads or writes an EXR file, because the thread waits for itself."""
    drjit = sys.modules["drjit"]
    if drjit.thread_count() < 2:
        drjit.set_thread_count(2)


def guard(mitsuba: ModuleType) -> None:
    """If LLVM does not work, makes ``mi.set_variant`` raise the error of :func:`check`.

    Dr.Jit's own message about a refused library says that there is none. If LLVM works,
    ``mi.set_variant`` is not changed.

    Args:
        mitsuba: The imported module.
    """
    if not llvm_problem():
        return
    original = mitsuba.set_variant

    def set_variant(*variants: str) -> None:
        try:
            original(*variants)
        except ImportError:
            for variant in variants:
                check(variant)
            raise

    mitsuba.set_variant = set_variant  # type: ignore[attr-defined]


def llvm_problem() -> str:
    """What is wrong with the LLVM library that Dr.Jit has loaded or will load, and how to fix it.

    Returns:
        Sentences for the user; empty if the library works.
    """
    if llvm.cpu_fault():
        return f"{llvm.cpu_fault()}. Select a cuda_* variant."
    loaded = "drjit" in sys.modules
    library = loaded_library() if loaded else llvm.default_library()
    if library is None:
        found = "Dr.Jit found no LLVM library"
    else:
        reason = llvm.fault(library)
        if loaded and not reason and not _loaded_version():
            reason = "Dr.Jit did not accept"
        if not reason:
            return ""
        found = f"Dr.Jit {'loaded' if loaded else 'would load'} {library}, which {reason}"
    return f"{found}. To fix this, {_remedy(library, loaded)}."


def loaded_library() -> llvm.Library | None:
    """The LLVM library in this process, with the exact version if Dr.Jit knows it. If Dr.Jit could
    not load one, the file that ``DRJIT_LIBLLVM_PATH`` names.
    """
    version = _loaded_version()
    try:
        with open("/proc/self/maps") as maps:
            paths = re.findall(r"\s(/\S*libLLVM\S*)$", maps.read(), re.MULTILINE)
    except OSError:  # not Linux
        paths = []
    if paths:
        library = llvm.Library.at(paths[0])
    elif os.environ.get(llvm.VARIABLE):
        library = llvm.Library.at(os.environ[llvm.VARIABLE])
    elif version:
        library = llvm.Library("")
    else:
        return None
    return llvm.Library(library.path, version or library.version)


def _loaded_version() -> tuple[int, ...]:
    """The version of the LLVM backend; empty if Dr.Jit could not start it."""
    version = sys.modules["drjit"].detail.llvm_version()
    return tuple(version) if version[0] >= 0 else ()


def _remedy(library: llvm.Library | None, loaded: bool) -> str:
    usable = llvm.usable_library()
    set_by_user = os.environ.get(llvm.VARIABLE)
    if usable and set_by_user and (library is None or usable.path != library.path):
        return f"unset {llvm.VARIABLE}, or run `export {llvm.VARIABLE}={usable.path}`"
    if usable and loaded:
        return (
            f"import mitsuba_ext before mitsuba and drjit (it chooses {usable.path}), "
            f"or run `export {llvm.VARIABLE}={usable.path}`"
        )
    from . import llvm_install

    unset = f" and unset {llvm.VARIABLE}" if set_by_user else ""
    return llvm_install.install_command() + unset
