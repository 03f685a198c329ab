"""Names of integrators, of plugins that can be nested in them, and of parameters; suggestions for
misspelt names.

This module does not import Mitsuba, which would take a second, so misspelt names are reported at
once.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from ..startup import plugin_folders, plugin_parameters
from ..util.errors import InputError, did_you_mean
from .plugin_text import parse_plugin

_SAMPLING = ("block_size", "hide_emitters", "samples_per_pass", "timeout")
_PATHS = ("max_depth", "rr_depth", *_SAMPLING)
_PROJECTIVE = (
    *_PATHS, "sppc", "sppp", "sppi", "guiding", "guiding_proj", "guiding_rounds", "project_seed",
)  # fmt: skip

#: Mitsuba's own integrators, and their parameters (without nested integrators).
MITSUBA_INTEGRATORS: Mapping[str, tuple[str, ...]] = {
    "aov": ("aovs", *_SAMPLING),
    "depth": _SAMPLING,
    "direct": ("shading_samples", "emitter_samples", "bsdf_samples", *_SAMPLING),
    "direct_projective": _PROJECTIVE,
    "moment": _SAMPLING,
    "path": _PATHS,
    "prb": _PATHS,
    "prb_basic": _PATHS,
    "prb_projective": _PROJECTIVE,
    "prbvolpath": _PATHS,
    "ptracer": tuple(key for key in _PATHS if key != "block_size"),
    "stokes": _SAMPLING,
    "volpath": _PATHS,
    "volpathmis": ("use_spectral_mis", *_PATHS),
    "volprim_rf_basic": ("srgb_primitives", *_PATHS),
}


#: The suffixes of Mitsuba's plugin files.
_LIBRARIES = (".so", ".dylib", ".dll")

#: The name that stands for the scene's own integrator.
OF_SCENE = "scene"


def unknown_plugin(name: str, is_nested: bool = False) -> InputError:
    """The error for a name of no integrator and, if ``is_nested``, of no decision."""
    kind = "nested plugin" if is_nested else "integrator"
    if name in _ours(is_nested=True):
        return InputError(
            f'"{name}" is not an integrator, but a decision to be nested in one '
            f"('mitsuba-ext list {name}' shows how)"
        )
    hint = did_you_mean(name, [*_ours(is_nested), *MITSUBA_INTEGRATORS])
    return InputError(f'unknown {kind} "{name}"{hint} (\'mitsuba-ext list\' shows ours)')


def unknown_parameter(kind: str, name: str, key: str) -> InputError:
    """The error for a parameter that a plugin did not read.

    Args:
        kind: The kind of plugin for the message: "integrator" or "nested plugin".
        name: Its name.
        key: The name of the parameter.
    """
    known = MITSUBA_INTEGRATORS.get(name, ())
    return InputError(f"{kind} {plugin_parameters.unread(name, key, known)}")


def explained(message: str) -> str:
    """Adds a similar known name, if any, to a message of Mitsuba's parser about an unknown plugin
    or an unknown parameter of an integrator."""
    plugin = re.search(r'Plugin "(\w+)" not found!', message)
    if plugin:
        known = [name for of_kind in plugin_folders.plugin_names().values() for name in of_kind]
        hint = did_you_mean(plugin[1], [*known, *MITSUBA_INTEGRATORS, *_files_of_mitsuba()])
        return message.replace(plugin[0], f"{plugin[0][:-1]}{hint}" if hint else plugin[0])
    unread = re.search(r'unreferenced propert.* plugin of type "(\w+)": \w+ "(\w+)"', message)
    if unread:
        return message + did_you_mean(unread[2], MITSUBA_INTEGRATORS.get(unread[1], ()))
    return message


def check_integrator(specification: str) -> None:
    """Refuses an unknown integrator, or an unknown plugin nested in one, before Mitsuba is
    imported. (Once it is imported, the user's plugins may be registered, and this does nothing.)

    Args:
        specification: A file, text that begins with the integrator's name, or :data:`OF_SCENE`.

    Raises:
        InputError: The plugin does not exist, or the text has the wrong form.
    """
    is_file = Path(specification).suffix.lower() in (".xml", ".json")
    if specification == OF_SCENE:
        return
    if not is_file and "mitsuba" not in sys.modules:  # otherwise it is checked later
        _check_plugin(parse_plugin(specification))


def is_plugin(name: str) -> bool:
    """Whether ``name`` is one of our integrators or decisions, or a Mitsuba plugin."""
    return name in (*_ours(True), *MITSUBA_INTEGRATORS) or is_file_of_mitsuba(name)


def _check_plugin(plugin: Mapping[str, Any], is_nested: bool = False) -> None:
    name = plugin["type"]
    is_known = name in (*_ours(is_nested), *MITSUBA_INTEGRATORS)
    if not is_known and not is_file_of_mitsuba(name):
        raise unknown_plugin(name, is_nested)
    for value in plugin.values():
        if isinstance(value, Mapping):
            _check_plugin(value, is_nested=True)


def _ours(is_nested: bool) -> list[str]:
    """The names of our integrators and, with ``is_nested``, of our decisions."""
    integrators = plugin_folders.plugin_names()["integrators"]
    return [*integrators, *(plugin_folders.decision_names() if is_nested else ())]


def is_file_of_mitsuba(name: str) -> bool:
    """Whether a C++ plugin has this name. Also true if Mitsuba is not found."""
    folder = _plugin_folder()
    if folder is None:
        return True
    return any((folder / f"{name}{suffix}").exists() for suffix in _LIBRARIES)


def _files_of_mitsuba() -> list[str]:
    """The names of the C++ plugins."""
    folder = _plugin_folder()
    files = folder.glob("*.*") if folder else ()
    return [file.stem for file in files if file.suffix in _LIBRARIES]


def _plugin_folder() -> Path | None:
    spec = PathFinder.find_spec("mitsuba")
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(spec.submodule_search_locations[0]) / "plugins"
