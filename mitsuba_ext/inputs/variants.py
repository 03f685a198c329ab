"""Selects a variant of Mitsuba, and imports the modules that register further plugins."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError


def select_variant(variant: str, plugins: Sequence[str] = ()) -> None:
    """Selects a variant, then imports the modules, whose classes are bound to the variant."""
    import mitsuba as mi

    from ..errors import one_line

    if variant not in mi.variants():
        raise InputError(f'unknown variant "{variant}" (there are: {", ".join(mi.variants())})')
    try:
        mi.set_variant(variant)
    except (ImportError, RuntimeError) as error:
        raise InputError(f'the variant "{variant}" does not start: {one_line(error)}') from error
    if plugins:
        sys.path.insert(0, "")  # modules in the current folder, as with python -m
    for name in plugins:
        try:
            _import_module(name)
        except Exception as error:  # a module may raise anything
            raise InputError(f'the plugin "{name}": {one_line(error)}') from error


def _import_module(name: str) -> None:
    path = Path(name)
    if path.suffix != ".py":
        importlib.import_module(name)
        return
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
