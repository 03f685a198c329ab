"""The folders of plugins, and the names that a scene can use."""

from __future__ import annotations

import importlib
from pathlib import Path

#: The Mitsuba function that registers the plugins of each folder.
KINDS: dict[str, str] = {
    "integrators": "register_integrator",
    "emitters": "register_emitter",
    "bsdfs": "register_bsdf",
    "samplers": "register_sampler",
    "sensors": "register_sensor",
    "shapes": "register_shape",
}


def plugin_names() -> dict[str, list[str]]:
    """The names that a scene can use, by kind: ``{"integrators": [...], …}``."""
    return {kind: [path.stem for path in plugin_files(kind)] for kind in KINDS}


def plugin_files(kind: str) -> list[Path]:
    """The source files of the plugins of one kind, sorted by name."""
    package = importlib.import_module(f"mitsuba_ext.{kind}")
    files = {path.stem: path for folder in package.__path__ for path in Path(folder).glob("*.py")}
    return [files[name] for name in sorted(files) if not name.startswith("_")]


def decision_names() -> list[str]:
    """The plugins that are samplers to Mitsuba and decisions of the walk to our integrators."""
    files = plugin_files("samplers")
    return [path.stem for path in files if "(DecisionPlugin)" in path.read_text(encoding="utf-8")]
