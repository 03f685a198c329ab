"""The parameters ``clamp_direct`` and ``clamp_indirect``, which trade bias for noise."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi

from ..planning.technique import ParameterReader

_KEYS = ("clamp_direct", "clamp_indirect")


def read_clamps(
    plugin: str, props: mi.Properties, read: ParameterReader, can_clamp: bool
) -> dict[str, float]:
    """The limits of an integrator, by parameter; empty if it cannot clamp.

    Raises:
        ValueError: A limit is negative, or given to an integrator that cannot clamp.
    """
    if can_clamp:
        return {key: read(key, 0.0, minimum=0) for key in _KEYS}
    for key in (key for key in _KEYS if key in props):
        raise ValueError(
            f'"{plugin}" has no parameter "{key}": only "composed_path", "auto_path" and '
            f"others that trace nothing but camera paths clamp light"
        )
    return {}


def clamped(limits: Mapping[str, float]) -> dict[str, float]:
    """The limits that clamp light: 0 does not."""
    return {key: limit for key, limit in limits.items() if limit > 0}


def refuse_expressions(plugin: str, limits: Mapping[str, float]) -> None:
    """Refuses clamps beside light path expressions.

    Raises:
        ValueError: Light is clamped.
    """
    for key, limit in clamped(limits).items():
        raise ValueError(
            f'"{plugin}": the parameter "{key}" is {limit:g}, but "aovs" has light path '
            f"expressions, whose light is not clamped and would not add up to the image: "
            f"leave one of them out"
        )


def bias_by(limits: Mapping[str, float]) -> str:
    """How the limits bias an image; empty if nothing is clamped."""
    described = ", ".join(f"{key} = {limit:g}" for key, limit in clamped(limits).items())
    return f"light is clamped ({described})" if described else ""
