"""Names of integrators, and suggestions for misspelt ones.

This module does not import Mitsuba, which takes a second: so a misspelt name is reported at once.
"""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterable
from importlib.machinery import PathFinder
from pathlib import Path

from . import registry
from .errors import InputError

#: Mitsuba's own integrators.
MITSUBA_INTEGRATORS = (
    "aov", "depth", "direct", "direct_projective", "moment", "path", "prb", "prb_basic",
    "prb_projective", "prbvolpath", "ptracer", "stokes", "volpath", "volpathmis",
    "volprim_rf_basic",
)  # fmt: skip


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """``': did you mean "neepp"?'``, or nothing if no known name resembles ``name``."""
    close = difflib.get_close_matches(name.lower(), known, n=1)
    return f': did you mean "{close[0]}"?' if close else ""


def unknown_integrator(name: str, kind: str = "integrator") -> InputError:
    """The error for a name that no integrator has; the message calls it a ``kind``."""
    known = [*registry.plugin_names()["integrators"], *MITSUBA_INTEGRATORS]
    return InputError(
        f'unknown {kind} "{name}"{did_you_mean(name, known)} (\'mitsuba-ext list\' shows ours)'
    )


def check_integrator(specification: str) -> None:
    """Refuses an unknown integrator before Mitsuba is imported. (Afterwards, plugins of the user
    may be registered, and this does nothing.)

    Args:
        specification: A file, or text that begins with the integrator's name.

    Raises:
        InputError: There is no such integrator.
    """
    is_file = Path(specification).suffix.lower() in (".xml", ".json")
    match = re.match(r"\w+", specification)
    if is_file or match is None or "mitsuba" in sys.modules:
        return  # checked later
    name = match[0]
    known = {*registry.plugin_names()["integrators"], *MITSUBA_INTEGRATORS}
    if name not in known and not is_file_of_mitsuba(name):
        raise unknown_integrator(name)


def is_file_of_mitsuba(name: str) -> bool:
    """Is there a plugin in C++ of this name? ``True`` also if Mitsuba is not found."""
    spec = PathFinder.find_spec("mitsuba")
    if spec is None or not spec.submodule_search_locations:
        return True
    folder = Path(spec.submodule_search_locations[0]) / "plugins"
    return any((folder / f"{name}{suffix}").exists() for suffix in (".so", ".dylib", ".dll"))
