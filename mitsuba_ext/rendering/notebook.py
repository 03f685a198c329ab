"""The statistics of a render as a small table for notebooks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from markupsafe import Markup

_ROW = Markup("<tr><th>{}</th><td>{}</td></tr>")


def statistics_table(statistics: Any) -> str:
    """HTML, without styles of its own, of a ``RenderStatistics``; all text is escaped."""
    rows = Markup("\n").join(_ROW.format(name, text) for name, text in _rows(statistics))
    return str(Markup("<table>\n{}\n</table>").format(rows))


def _rows(statistics: Any) -> Iterator[tuple[str, str]]:
    end = ", interrupted" if statistics.interrupted else ""
    passes = f"{statistics.passes} pass{'' if statistics.passes == 1 else 'es'}"
    yield "samples per pixel", f"{statistics.spp:,} in {passes}{end}"
    parts = {
        "learning": statistics.learning_seconds, "compiling": statistics.compile_seconds,
        "tracing": statistics.tracing_seconds,
    }  # fmt: skip
    yield "seconds", f"{statistics.seconds:.2f}" + _in_brackets(
        f"{name} {seconds:.2f}" for name, seconds in parts.items() if seconds > 0
    )
    rays = {name: count for name, count in statistics.rays.items() if count}
    yield "rays", f"{sum(rays.values()):,}" + _in_brackets(
        f"{name} {count:,}" for name, count in rays.items()
    )
    if statistics.memory:
        yield "memory", f"{statistics.memory / 2**20:,.0f} MiB"
    if statistics.learned:
        yield "learned", statistics.learned
    for decision, effect in statistics.effects.items():
        yield decision, _effect(effect)


def _in_brackets(parts: Iterator[str]) -> str:
    text = ", ".join(parts)
    return f" ({text})" if text else ""


def _effect(effect: Mapping[str, Any]) -> str:
    """As the pilots predict it, relative to a render without the decision."""
    figures = [f"{name} {effect[name]:.2f} x" for name in ("variance", "time") if name in effect]
    return ("kept" if effect["is_kept"] else "not kept") + _in_brackets(iter(figures))
