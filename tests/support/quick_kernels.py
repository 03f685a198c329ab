"""Kernels that compile quickly, for tests that compile more than they render.

With few samples on small films, a test spends most of its time in LLVM's optimisation passes. LLVM
22 skips these if this module is imported before Dr.Jit; kernels are then up to twice as slow. With
``MITSUBA_EXT_TEST_KERNELS=optimised``, tests compile as users do; so do the processes that tests
start, and the tutorials of ``make docs``.
"""

from __future__ import annotations

import ctypes
import mmap
import os

from mitsuba_ext.startup import llvm, runtime
from tests.support.paths import ROOT

#: Run no pass that is optional, and say nothing about it.
_OPTIONS = (b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0")

#: Where quick kernels are stored, also by processes that tests start. The renders of a user must
#: not find kernels that are slow.
_FOLDER = ROOT / ".pytest_cache" / "kernels"


def _compile_quickly() -> None:
    runtime.choose_llvm()
    library = llvm.default_library()
    if library is None or not os.path.isfile(library.path) or not _can_be_silent(library.path):
        return
    os.environ["DRJIT_CACHE_DIR"] = str(_FOLDER)
    arguments = (ctypes.c_char_p * (1 + len(_OPTIONS)))(b"pytest", *_OPTIONS)
    # Dr.Jit opens the same file, and so the same library
    ctypes.CDLL(library.path).LLVMParseCommandLineOptions(len(arguments), arguments, None)


def _can_be_silent(path: str) -> bool:
    """Whether the library has both options. LLVM 19 prints a line for each pass."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(_OPTIONS[-1].strip(b"-").partition(b"=")[0]) >= 0


if os.environ.get("MITSUBA_EXT_TEST_KERNELS", "quick") == "quick":
    _compile_quickly()
