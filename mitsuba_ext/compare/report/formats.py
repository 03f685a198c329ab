"""Formats the report's numbers: three significant digits, a unit, and the interval in that unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

#: Maps a value to the factor by which it is divided and the unit printed after it.
Unit = Callable[[float], "tuple[float, str]"]

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_NARROW_SPACE = "\u202f"


class Text(NamedTuple):
    """A figure as text. ``interval`` is empty if unknown."""

    value: str
    interval: str = ""


#: The text of an unknown figure.
UNKNOWN = Text("–")


def quantity(value: float, unit: Unit) -> str:
    """A value with its unit."""
    factor, name = unit(value)
    if factor == 1 and value == int(value) and abs(value) < 1e5:
        text = f"{int(value)}".replace("-", "−")  # an exact count: 4096 is not 4100, 8 not 8.00
    else:
        text = digits(value / factor)
    return text + name


def number(value: float) -> str:
    """A number without a unit, with a power of ten if it is very small or large."""
    return quantity(value, plain)


def figure(estimate: Mapping[str, float | None] | None, unit: Unit) -> Text:
    """A figure of ``results.json`` with its interval, both in the unit that suits the value."""
    if estimate is None or estimate["value"] is None:
        return UNKNOWN
    low, high = estimate.get("low"), estimate.get("high")
    value = quantity(estimate["value"], unit)
    if low is None or high is None:
        return Text(value)
    factor, _ = unit(estimate["value"])
    ends = number(low / factor), number(high / factor)
    if ends[0] == ends[1]:
        return Text(value)  # a count that is equal, or nearly so, in all runs
    # "to" for negative bounds: a dash next to a minus sign would be hard to read
    dash = "–" if low >= 0 else " to "
    return Text(value, dash.join(ends))


def short(value: float) -> str:
    """A round number, as on an axis: 0.01 instead of 0.0100, 10⁻⁵ instead of 1·10⁻⁵."""
    factor, exponent = plain(value)
    text = f"{float(f'{value / factor:.2e}'):.10g}".replace("-", "−")
    return exponent[1:] if text == "1" and exponent else text + exponent


def digits(value: float) -> str:
    """Three significant digits without an exponent: 0.0123, 1.20, 45.6, 12 300."""
    rounded = float(f"{value:.2e}")
    if rounded == 0:
        return "0"
    decimals = max(0, 2 - math.floor(math.log10(abs(rounded))))
    text = f"{rounded:,.{decimals}f}" if abs(rounded) >= 10_000 else f"{rounded:.{decimals}f}"
    return text.replace(",", _NARROW_SPACE).replace("-", "−")


def plain(value: float) -> tuple[float, str]:
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return 1, ""
    exponent = math.floor(math.log10(abs(float(f"{value:.2e}"))))
    return 10.0**exponent, f"·10{str(exponent).translate(_SUPERSCRIPTS)}"


def percent(value: float) -> tuple[float, str]:
    return 0.01, f"{_NARROW_SPACE}%"


def times(value: float) -> tuple[float, str]:
    """A ratio."""
    factor, exponent = plain(value)
    return factor, f"{exponent}×"


def seconds(value: float) -> tuple[float, str]:
    return _prefixed(value, (1, "s"), (1e-3, "ms"), (1e-6, "µs"))


def byte_count(value: float) -> tuple[float, str]:
    return _prefixed(value, (1e9, "GB"), (1e6, "MB"), (1e3, "kB"), (1, "B"))


def count(value: float) -> tuple[float, str]:
    """Large counts, such as rays."""
    factor, unit = _prefixed(value, (1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1, ""))
    return factor, unit if factor > 1 else ""


def _prefixed(value: float, *units: tuple[float, str]) -> tuple[float, str]:
    """The largest unit in which ``value`` is at least 1. For the unit without a prefix, 0.1 is
    enough."""
    for factor, unit in units:
        if abs(value) >= factor * (0.1 if factor == 1 else 1):
            return factor, _NARROW_SPACE + unit
    factor, unit = units[-1] if value else next(pair for pair in units if pair[0] == 1)
    return factor, _NARROW_SPACE + unit

