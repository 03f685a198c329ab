"""Registers every plugin of the package in each variant that is selected.

A plugin is a file in ``integrators/``, ``emitters/``, ``bsdfs/``, ``samplers/``, ``sensors/``
or ``shapes/``.
The file's name is the plugin's name in a scene. Mitsuba instantiates the one class in the file that
is decorated with :func:`plugin`. Deleting the file removes the plugin.

Mitsuba's base classes differ from variant to variant, so a class body binds to the variant that is
active when it runs. The plugin files, and the files of :func:`variant_bound` classes, are therefore
executed once per variant (as Mitsuba does with its own Python integrators). The rest of the package
does not depend on the variant.
"""

from __future__ import annotations

import importlib
import sys
import threading
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING

from . import runtime
from .plugin_folders import KINDS, plugin_names
from .plugin_parameters import refuse_unread

if TYPE_CHECKING:
    import mitsuba as mi

#: The modules of variant-bound base classes, each after the modules of its own base classes.
_bases: list[str] = []

_registered: set[str] = set()
_registering = threading.RLock()

#: The kinds of plugins whose methods kernels call.
_CALLED = ("emitters", "bsdfs", "shapes", "sensors")
_alive: weakref.WeakSet[mi.Object] = weakref.WeakSet()


def plugin(cls: type) -> type:
    """Class decorator: makes ``cls`` the plugin that its file is named after."""
    import mitsuba as mi

    _, kind, name = cls.__module__.rsplit(".", 2)

    def made(props: mi.Properties) -> mi.Object:
        instance = cls(props)
        refuse_unread(instance, props)
        if kind in _CALLED:
            _alive.add(instance)
        return instance

    getattr(mi, KINDS[kind])(name, made)
    return cls


def variant_bound(cls: type) -> type:
    """Class decorator: executes the file of ``cls``, a base class of plugins, once per variant."""
    if cls.__module__ not in _bases:
        _bases.append(cls.__module__)
    return cls


def is_any_called() -> bool:
    """Whether any of our plugins whose methods kernels call is in memory. Dr.Jit traces the methods
    of all objects of a kind, even in scenes that are not rendered."""
    return len(_alive) > 0


def install() -> None:
    """Registers the plugins now if a variant is active, and whenever one is selected later."""
    import mitsuba as mi

    mi.detail.add_variant_callback(lambda _old, new: _register(new))
    if mi.variant() is not None:
        _register(mi.variant())


def _register(variant: str) -> None:
    with _registering:  # another thread may also select the variant
        if variant not in _registered:
            _register_plugins(variant)


def _register_plugins(variant: str) -> None:
    import mitsuba as mi

    if variant in runtime.SUPPORTED_VARIANTS:
        runtime.check(variant)
        runtime.check_meshes(mi.Mesh)
        for module in (*_bases, *_plugin_modules()):
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
    """In a variant that our plugins do not support, registers constructors that raise errors."""
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
            getattr(mi, KINDS[kind])(name, refuse(name))
