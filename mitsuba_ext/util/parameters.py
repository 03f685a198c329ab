"""Reads the parameters of a plugin, with error messages for the author of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .errors import did_you_mean

if TYPE_CHECKING:
    import mitsuba as mi

#: The maximum number of samples per pixel: structured samplers cannot count further.
MOST_SPP = 2**30


def read_parameter(
    plugin: str,
    props: mi.Properties,
    key: str,
    default: Any,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] = (),
) -> Any:
    """Reads and checks a parameter of the scene. Its type is the type of ``default``.

    Args:
        plugin: Name of the plugin, for error messages.
        props: The properties that the plugin got.
        key: The parameter's name.
        default: Its value if the scene does not set it.
        minimum, maximum: The smallest and the largest value accepted.
        choices: The values accepted; empty if all are.

    Raises:
        TypeError: The value has another type (an integer is accepted as a float).
        ValueError: The value is out of range, or not one of ``choices``.
    """
    value = props.get(key, default)
    kind = type(default)
    if kind is float and type(value) is int:
        value = float(value)

    def message(accepted: str) -> str:
        return f'"{plugin}": the parameter "{key}" is {value!r}; it must be {accepted}'

    if type(value) is not kind:
        raise TypeError(message(f"of type {kind.__name__}"))
    if kind is float and not math.isfinite(value):
        raise ValueError(message("finite"))
    if choices and value not in choices:
        hint = did_you_mean(value, choices) if isinstance(value, str) else ""
        raise ValueError(message(f"one of {', '.join(choices)}{hint}"))
    if minimum is not None and not value >= minimum:
        raise ValueError(message(f"at least {minimum}"))
    if maximum is not None and not value <= maximum:
        raise ValueError(message(f"at most {maximum}"))
    return value
