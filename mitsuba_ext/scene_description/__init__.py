"""A function for each of our plugins, with its parameters as named arguments::

    import mitsuba_ext
    import mitsuba as mi
    from mitsuba_ext.scene_description import auto, dispersive_dielectric

    mi.set_variant("llvm_ad_spectral")
    integrator = mi.load_dict(auto(max_depth=8))
    glass = dispersive_dielectric(int_ior="sf11")    # {"type": "dispersive_dielectric", …}

Editors complete names, types and defaults, and type checkers find misspelled names: the file
``__init__.pyi`` beside this one has the signatures. ``make stubs`` writes it from the pages of the
plugins.

A function returns a dict for ``mi.load_dict``, with the parameters that it was given. Nested
plugins are such dicts, objects of Mitsuba, or objects of ``mitsuba-scene-description``, whose
scenes in turn accept these dicts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from .arguments import plugin_names
from .functions import function_of

__all__ = plugin_names()  # noqa: PLE0605

_function = functools.cache(function_of)


def __getattr__(name: str) -> Callable[..., dict[str, Any]]:
    if name in __all__:
        return _function(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
