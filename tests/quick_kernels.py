"""Kernels that compile quickly, for tests that compile more than they render.

With few samples on small films, a test spends most of its time in LLVM's optimisation passes. LLVM
skips these if this module is imported before Dr.Jit; kernels are then up to twice as slow. Long
statistics (``pytest -m slow``) compile as users do.
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

from mitsuba_ext.startup import llvm

#: Run no pass that is optional, and say nothing about it.
_OPTIONS = (b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0")

#: "quick" or "optimised": the process that begins decides, and its workers inherit it.
_VARIABLE = "MITSUBA_EXT_TEST_KERNELS"


#: Where quick kernels are stored, also by processes that tests start. The renders of a user must
#: not find kernels that are slow.
_FOLDER = Path(__file__).parents[1] / ".pytest_cache" / "kernels"


def _compile_quickly() -> None:
    library = llvm.default_library()
    if library is None or not library.path:
        return
    os.environ["DRJIT_CACHE_DIR"] = str(_FOLDER)
    arguments = (ctypes.c_char_p * (1 + len(_OPTIONS)))(b"pytest", *_OPTIONS)
    # Dr.Jit opens the same file, and so the same library
    ctypes.CDLL(library.path).LLVMParseCommandLineOptions(len(arguments), arguments, None)


if os.environ.setdefault(_VARIABLE, "optimised" if "slow" in sys.argv else "quick") == "quick":
    _compile_quickly()
