"""Iterates over the parameters of a scene that have a value."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import mitsuba as mi


def values_of(
    parameters: mi.SceneParameters, keys: Iterable[str] | None = None
) -> Iterator[tuple[str, Any]]:
    """Keys and values, of all parameters or of those with these ``keys``, without parameters that
    are ``None``, for which Mitsuba 3.9.1 raises a ``TypeError`` (such as ``sigma_a`` of a ``hair``
    given by its pigments)."""
    for key in parameters.keys() if keys is None else keys:
        value, kind, *_ = parameters.properties[key]
        if value is not None or kind is not None:
            yield key, parameters[key]
