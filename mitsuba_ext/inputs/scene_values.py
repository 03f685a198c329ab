"""Sets values of a scene's objects, by keys of ``mi.traverse``, without loading the scene again.

Values are passed as JSON text, which requests to other processes can hold and compare.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.errors import InputError, did_you_mean, one_line


def as_text(values: Mapping[str, Any]) -> str:
    """Values as JSON text; empty if there are none.

    Args:
        values: Numbers, lists of them, NumPy and Dr.Jit arrays, and transforms, by key.

    Raises:
        InputError: A value has another type.
    """
    plain = {key: _plain(key, value) for key, value in values.items()}
    return json.dumps(plain, sort_keys=True) if plain else ""


def _plain(key: str, value: Any) -> Any:
    if _is_transform(value):
        value = np.squeeze(np.array(value.matrix))
    elif dr.is_array_v(value):
        value = np.squeeze(np.array(value))
    try:
        found = np.asarray(value)
        if found.dtype.kind in "biuf" and np.isfinite(found).all():
            return found.tolist()
    except (TypeError, ValueError):  # a ragged list
        pass
    raise InputError(
        f'the value of "{key}" must be a number, a list or array of numbers, or a transform, and '
        f"finite: found {type(value).__name__}"
    )


class SceneValues:
    """Sets and resets values of a scene.

    Parameters:
        scene: The scene, loaded with ``keep_names``.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self._parameters = mi.traverse(scene)
        self._before: dict[str, Any] = {}

    def set(self, text: str) -> None:
        """Sets values, and resets all other values set before to the scene's own.

        Args:
            text: The values, from :func:`as_text`.

        Raises:
            InputError: The scene has no such parameter, or the parameter does not accept the value.
        """
        values = json.loads(text) if text else {}
        found = self._parameters
        for key in values:
            if key not in found:
                raise InputError(_unknown(key, list(found.keys())))
            if key not in self._before:
                self._before[key] = _copy(found[key])
        for key, own in self._before.items():
            try:
                found[key] = _like(own, values[key]) if key in values else _copy(own)
            except (TypeError, ValueError, RuntimeError) as error:
                raise InputError(
                    f'"{key}" cannot be set to {_short(values[key])}: it is of type '
                    f"{type(own).__name__} ({one_line(error)})"
                ) from None
        if self._before:
            found.update()


def _copy(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else type(value)(value)


def _like(own: Any, value: Any) -> Any:
    """Converts a value to the type of the scene's own. Arrays must keep their size, on which other
    parameters depend."""
    kind = type(own)
    if isinstance(own, (bool, int, float)):
        if isinstance(value, list):
            raise ValueError("one number is expected")
        return kind(value)
    if _is_transform(own) or dr.is_tensor_v(own):
        shape = np.squeeze(np.array(own.matrix)).shape if _is_transform(own) else own.shape
        array = np.array(value, dtype=np.float32)
        if array.shape != tuple(shape):
            raise ValueError(f"{'x'.join(map(str, shape))} numbers are expected")
        return kind(array)
    # A single number can stand for a colour, but not for a list of vertices
    is_flexible = dr.size_v(kind) != dr.Dynamic and not isinstance(value, list)
    if not is_flexible and np.size(value) != len(own):
        raise ValueError(f"{len(own)} numbers are expected")
    result = kind(value)
    # Literals would be compiled into the kernel
    dr.make_opaque(result)
    return result


def _is_transform(value: Any) -> bool:
    return "Transform" in type(value).__name__


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else f"{text[:50]}…"


def _unknown(key: str, known: list[str]) -> str:
    """Says that a scene has no such parameter, and suggests the one that was probably meant."""
    name = key.partition(".")[0]
    own = [each for each in known if each.startswith(f"{name}.")]
    if own:
        listed = ", ".join(f'"{each}"' for each in own[:5])
        hint = did_you_mean(key, own) or f": it has {listed}"
    else:
        # Mitsuba calls objects without an id "object_" and their address
        ids = {each.partition(".")[0] for each in known if not re.match(r"object_\d+\.", each)}
        hint = f': no object of the file has the id "{name}"{did_you_mean(name, ids)}'
    return f'the scene has no parameter "{key}"{hint}'
