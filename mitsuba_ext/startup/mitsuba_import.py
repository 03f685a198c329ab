"""Hooks into the import of Dr.Jit and Mitsuba, no matter which module imports them.

Before Dr.Jit is imported, a hook chooses an LLVM library that works. After Mitsuba is imported,
another hook registers the plugins. ``import mitsuba_ext`` imports neither, because that takes most
of a second, and commands that only print, such as ``mitsuba-ext list``, do not need them.
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from importlib.machinery import ModuleSpec
from types import ModuleType

from . import runtime
from .signals import signals_wait


def prepare() -> None:
    """Registers the plugins: now if Mitsuba is already imported, otherwise when it is imported.

    Raises:
        InstallationError: Mitsuba is imported, and its version is not supported.
    """
    if "mitsuba" in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _Finder())


def _register() -> None:
    from . import registry

    mitsuba = sys.modules["mitsuba"]  # not the executed module, which Mitsuba replaces
    runtime.check_version(mitsuba.__version__)
    runtime.guard(mitsuba)
    runtime.ensure_two_threads()
    registry.install()


@contextlib.contextmanager
def _around_drjit() -> Iterator[None]:
    runtime.check_installed_version()
    runtime.choose_llvm()
    with signals_wait(), runtime.missing_library_is_named():
        yield


@contextlib.contextmanager
def _around_mitsuba() -> Iterator[None]:
    runtime.check_installed_version()
    with signals_wait():
        yield
        _register()


class _Finder:
    """Finds Dr.Jit and Mitsuba with the other finders of ``sys.meta_path``, and runs the hooks
    before and after their modules are executed."""

    _AROUND: dict[str, Callable[[], AbstractContextManager[None]]] = {
        "drjit": _around_drjit,
        "mitsuba": _around_mitsuba,
    }

    def __init__(self) -> None:
        self._searching: set[str] = set()

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name not in self._AROUND or name in self._searching:
            return None
        self._searching.add(name)
        try:
            spec = importlib.util.find_spec(name)  # calls this finder too, which returns None
        finally:
            self._searching.remove(name)
        if spec is None or spec.loader is None:
            return spec
        execute, around = spec.loader.exec_module, self._AROUND[name]

        def exec_module(module: ModuleType) -> None:
            with around():
                execute(module)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec
