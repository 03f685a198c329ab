"""Hashes that identify scenes and integrators by their files, parameters and code."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..scene.parameter_values import values_of
from ..startup import plugin_folders

_PACKAGE = Path(__file__).parents[1]

#: Modules whose classes are written in C++.
_COMPILED = ("builtins", "mitsuba", "drjit.detail")


def hash_each(files: Iterable[Path]) -> dict[Path, str]:
    """SHA-256 of each file, by its path with links resolved."""
    return {
        file: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted({file.resolve() for file in files})
    }


def hash_files(
    hashes: Mapping[Path, str], parameters: Mapping[str, str], source: object = None
) -> str:
    """SHA-256 over a scene's files and parameters.

    Args:
        hashes: The hashes of the files, from :func:`hash_each`.
        parameters: Values of the ``$name`` placeholders.
        source: The dict from which the scene was made, if not from a file.
    """
    digest = hashlib.sha256(repr(sorted(parameters.items())).encode())
    for file in hashes:
        digest.update(bytes.fromhex(hashes[file]))
    if source is not None:
        _feed(digest, source)
    return digest.hexdigest()


def hash_value(value: object) -> str:
    """SHA-256 over text, or over a dict for ``mi.load_dict``."""
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def hash_code(classes: Iterable[type]) -> str | None:
    """SHA-256 over the Python files that define these classes of plugins.

    If any of them is written in Python, all files of this package that take part in a render are
    included, because the class may import any of them.

    Returns:
        Empty if all classes are written in C++; ``None`` if a class has no file (for example,
        because it is defined in a notebook).
    """
    bases = {base for cls in classes for base in cls.__mro__ if base.__module__ not in _COMPILED}
    if not bases:
        return ""
    files = {
        path
        for path in _PACKAGE.rglob("*.py")
        if path.relative_to(_PACKAGE).parts[0] not in ("compare", "cli")
    }
    for kind in plugin_folders.plugin_names():
        files.update(plugin_folders.plugin_files(kind))
    for base in bases:
        try:
            files.add(Path(inspect.getfile(base)))
        except (TypeError, OSError):
            return None
    if not all(file.is_file() for file in files):
        return None
    digest = hashlib.sha256()
    for file in sorted({file.resolve() for file in files}):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _feed(digest: Any, value: object) -> None:
    """Adds a value of a scene's dict to ``digest``: nested dicts, numbers, arrays, transformations,
    objects."""
    import mitsuba as mi

    if isinstance(value, Mapping):
        for key in value:  # in the scene's order, which determines the order of the emitters
            digest.update(f"{key}={{".encode())
            _feed(digest, value[key])
            digest.update(b"}")
    elif isinstance(value, (list, tuple)):
        for item in value:
            _feed(digest, item)
            digest.update(b",")
    elif isinstance(value, (mi.Bitmap, mi.VolumeGrid)):
        digest.update(np.array(value).tobytes())
    elif isinstance(value, mi.Object):
        digest.update(str(value).encode())
        for key, item in sorted(values_of(mi.traverse(value)), key=lambda pair: pair[0]):
            digest.update(key.encode())
            _feed(digest, item)
    elif hasattr(value, "matrix"):  # a transformation
        digest.update(np.array(value.matrix).tobytes())
    elif isinstance(value, (str, bool, int, float)) or value is None:
        digest.update(repr(value).encode())
    else:  # NumPy, Dr.Jit and other arrays
        array = np.array(value)
        digest.update(repr(value).encode() if array.dtype == object else array.tobytes())
