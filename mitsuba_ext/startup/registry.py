"""Registers every plugin of the package in each variant that is selected.

A plugin is a file in ``integrators/``, ``emitters/``, ``bsdfs/``, ``samplers/``, ``sensors/``
or ``shapes/``.
The file's name is the plugin's name in a scene, and the one class that the file defines and
decorates with :func:`plugin` is what Mitsuba instantiates. Deleting the file removes the plugin.

Mitsuba's base classes differ from variant to variant, so a class body binds to the variant that is
active when it runs. The plugin files are therefore executed once per variant (as Mitsuba does with
its own Python integrators). The rest of the package does not depend on the variant.
"""

from __future__ import annotations

import importlib
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from . import runtime

if TYPE_CHECKING:
    import mitsuba as mi

#: For each folder of plugins, the function of Mitsuba that registers them.
_KINDS: dict[str, str] = {
    "integrators": "register_integrator",
    "emitters": "register_emitter",
    "bsdfs": "register_bsdf",
    "samplers": "register_sampler",
    "sensors": "register_sensor",
    "shapes": "register_shape",
}

#: Variant-bound base classes, executed before the plugins that derive from them.
_BASES = (
    "mitsuba_ext.bases.staged_integrator",
    "mitsuba_ext.bases.decision_plugin",
    "mitsuba_ext.bases.walk_integrator",
    "mitsuba_ext.bases.remembering_path",
    "mitsuba_ext.bases.sensitive_path",
    "mitsuba_ext.bases.bidirectional_integrator",
    "mitsuba_ext.bases.chain_integrator",
    "mitsuba_ext.bases.metropolis_integrator",
    "mitsuba_ext.bases.wrapping_integrator",
    "mitsuba_ext.bases.reweighted_camera",
    "mitsuba_ext.bases.sequence_sampler",
    "mitsuba_ext.scene.luminaires.area_luminaire",
    "mitsuba_ext.scene.luminaires.moving_emitter",
)

_registered: set[str] = set()
_registering = threading.RLock()

#: The kinds of plugins whose methods kernels call, and their instances that are in memory.
_CALLED = ("emitters", "bsdfs", "shapes", "sensors")
_alive: weakref.WeakSet[mi.Object] = weakref.WeakSet()


def plugin(cls: type) -> type:
    """Class decorator: makes ``cls`` the plugin that its file is named after."""
    import mitsuba as mi

    _, kind, name = cls.__module__.rsplit(".", 2)

    def made(props: mi.Properties) -> mi.Object:
        from .plugin_parameters import refuse_unread  # it imports this module

        instance = cls(props)
        refuse_unread(instance, props)
        if kind in _CALLED:
            _alive.add(instance)
        return instance

    getattr(mi, _KINDS[kind])(name, made)
    return cls


def is_any_called() -> bool:
    """Is there a plugin of ours in memory whose methods kernels call? Dr.Jit traces the methods of
    all objects of a kind, also of those in scenes that are not rendered."""
    return len(_alive) > 0


def plugin_names() -> dict[str, list[str]]:
    """The names that a scene can use, by kind: ``{"integrators": [...], …}``."""
    return {kind: [path.stem for path in plugin_files(kind)] for kind in _KINDS}


def plugin_files(kind: str) -> list[Path]:
    """The source files of the plugins of one kind, sorted by name."""
    package = importlib.import_module(f"mitsuba_ext.{kind}")
    files = {path.stem: path for folder in package.__path__ for path in Path(folder).glob("*.py")}
    return [files[name] for name in sorted(files) if not name.startswith("_")]


def decision_names() -> list[str]:
    """The plugins that are samplers to Mitsuba, but decisions of the walk to our integrators."""
    files = plugin_files("samplers")
    return [path.stem for path in files if "(DecisionPlugin)" in path.read_text(encoding="utf-8")]


def install() -> None:
    """Registers the plugins now, if a variant is active, and whenever one is selected later."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _old, new: _register(new))
    if mi.variant() is not None:
        _register(mi.variant())


def _register(variant: str) -> None:
    with _registering:  # another thread may select the variant, too
        if variant not in _registered:
            _register_plugins(variant)


def _register_plugins(variant: str) -> None:
    import mitsuba as mi

    if variant in runtime.SUPPORTED_VARIANTS:
        runtime.check(variant)
        runtime.check_meshes(mi.Mesh)
        for module in (*_BASES, *_plugin_modules()):
            _execute(module)
    else:
        _register_refusals(variant)
    _registered.add(variant)


def _plugin_modules() -> list[str]:
    kinds = plugin_names().items()
    return [f"mitsuba_ext.{kind}.{name}" for kind, names in kinds for name in names]


def _execute(module: str) -> None:
    if module in sys.modules:
        importlib.reload(sys.modules[module])
    else:
        importlib.import_module(module)


def _register_refusals(variant: str) -> None:
    """In a variant that our plugins do not support, registers their names with constructors that
    raise an error which says so."""
    import mitsuba as mi

    def refuse(name: str) -> Callable[[mi.Properties], None]:
        def constructor(_props: mi.Properties) -> None:
            raise RuntimeError(
                f'"{name}" does not work in the variant "{variant}": select one of '
                f"{', '.join(runtime.SUPPORTED_VARIANTS)}."
            )

        return constructor

    for kind, names in plugin_names().items():
        for name in names:
            getattr(mi, _KINDS[kind])(name, refuse(name))
