"""Selects a variant of Mitsuba, and imports the modules that register further plugins."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from ..startup.signals import signals_wait
from ..util.errors import InputError, did_you_mean


def select_variant(variant: str, plugins: Sequence[str] = ()) -> None:
    """Selects a variant, then imports the modules, whose classes are bound to the variant."""
    import mitsuba as mi

    from ..util.errors import one_line

    if variant not in mi.variants():
        known = mi.variants()
        hint = did_you_mean(variant, known)
        raise InputError(f'unknown variant "{variant}"{hint} (there are: {", ".join(known)})')
    try:
        with signals_wait():
            mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        why = one_line(error)
        if "backend hasn't been initialized" in why:
            what = "GPU of NVIDIA" if variant.startswith("cuda") else "LLVM library"
            why = f"Dr.Jit found no {what} that it can use ('mitsuba-ext doctor' says why)"
        raise InputError(f'the variant "{variant}" does not start: {why}') from error
    for name in plugins:
        try:
            _import_module(name)
        except Exception as error:  # a module may raise anything
            raise InputError(f'the plugin "{name}": {one_line(error)}') from error


def import_from_here(name: str) -> ModuleType:
    """Imports a module, possibly from the current folder. (A command installed by pip does not
    search it.) Installed modules take precedence, and later imports do not search the folder: a
    file there must not shadow a module that other code imports."""
    here = os.getcwd()
    if here in sys.path:
        return importlib.import_module(name)
    sys.path.append(here)
    try:
        return importlib.import_module(name)
    finally:
        with contextlib.suppress(ValueError):  # the module has removed it
            sys.path.remove(here)


def _import_module(name: str) -> None:
    path = Path(name)
    if path.suffix != ".py":
        import_from_here(name)
        return
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
