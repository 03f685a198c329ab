"""The results of a comparison on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

_LEGEND = (
    "Means over the rounds (seconds: median), with 95 % confidence intervals over them (as a "
    "factor: +50 % upwards is −33 % downwards); compilation excluded, learning included. "
    "eff. = 1 / (relMSE · seconds), relative to the first; shadow = shadow rays traced, of those "
    "that 'path' would trace."
)


def tables(results: Mapping[str, Any]) -> Iterator[Table | Text]:
    """A table for each scene, with what a reader has to know to trust it.

    Args:
        results: The content of ``results.json``.
    """
    for scene in results["scenes"]:
        if scene["error"]:
            yield Text(f"{scene['name']}: {scene['error']}\n", style="red")
            continue
        yield _scene_table(scene, results["budget"])
        yield Text("\n".join(_notes(scene)) + "\n")
    yield Text(_LEGEND)


def show(results: Mapping[str, Any]) -> None:
    """Prints the tables, in a terminal as in a notebook."""
    from rich.console import Console

    console = Console()
    for part in tables(results):
        console.print(part, highlight=False)


def _scene_table(scene: Mapping[str, Any], budget: Mapping[str, Any]) -> Table:
    table = Table(
        title=_title(scene, budget), title_justify="left", title_style="", box=box.SIMPLE_HEAD,
        show_edge=False, padding=(0, 1, 0, 0),
    )
    table.add_column("integrator", overflow="fold", min_width=12)
    has_levels = budget["kind"] in ("sweep", "until")
    headings = ["relMSE", "trimmed", "σ/μ", "FLIP", "spp", "seconds", "shadow", "eff."]
    headings += ["slope"] if has_levels else []
    headings += ["s to target"] if budget["kind"] == "until" else []
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for contender in scene["integrators"]:
        label = Text(contender["label"])
        if contender["error"]:
            label.append(f"\n{contender['error']}", style="red")
        if not contender["levels"]:
            table.add_row(label, *["–"] * len(headings))
            continue
        level = contender["levels"][-1]
        figures = level["figures"]
        row = [
            *(_number(figures[name]) for name in ("relmse", "relmse_trimmed", "sigma_mu", "flip")),
            _number(figures["spp"], spread=False),
            _number(figures["seconds"]),
            _percent(figures["shadow_share"]),
            _ratio(level["ratios"]["efficiency"]),
        ]
        if has_levels:
            row.append(_difference(contender["slopes"]["spp"]))
        if budget["kind"] == "until":
            row.append(_number((contender["target"] or {}).get("seconds")))
        table.add_row(label, *row)
    return table


def _title(scene: Mapping[str, Any], budget: Mapping[str, Any]) -> str:
    settings = ", ".join(f"{key} {value}" for key, value in scene["settings"].items())
    values = ", ".join(f"{value:g}" for value in budget["values"])
    unit = {"time": f"{values} s", "until": f"until relMSE {values}"}
    size = "x".join(map(str, scene["size"]))
    given = unit.get(budget["kind"], f"{values} spp")
    return ", ".join(filter(None, [scene["path"] or scene["name"], size, given, settings]))


def _notes(scene: Mapping[str, Any]) -> Iterator[str]:
    reference = scene["reference"]
    if reference:
        noise = reference["noise"]
        note = "" if noise is None else f", relMSE of its own {noise:.2g}, subtracted"
        yield f"Reference: {reference['path']}{note}."
    for warning in scene["warnings"]:
        yield f"Warning: {warning}."
    for contender in scene["integrators"]:
        for note in contender["notes"]:
            yield f"{contender['label']}: {note}."
        for level in contender["levels"]:
            if level["refused"]:
                yield f"{contender['label']} at {level['level']:g}: {level['refused']}."


def _number(estimate: Mapping[str, float] | None, spread: bool = True) -> str:
    if estimate is None or estimate["value"] is None:
        return "–"
    value, high = estimate["value"], estimate["high"]
    if not spread:
        return f"{value:.6g}"
    if high is None or not value > 0:
        return f"{value:#.3g}"
    factor = high / value
    return f"{value:#.3g} " + (f"±{factor - 1:.0%}" if factor < 11 else "± >1000%")


def _percent(estimate: Mapping[str, float] | None) -> str:
    return "–" if estimate is None else f"{estimate['value']:.1%}"


def _ratio(estimate: Mapping[str, float] | None) -> str:
    if estimate is None:
        return "–"
    if estimate["low"] is None:
        return f"{estimate['value']:.2f}x"
    return f"{estimate['value']:.2f}x [{estimate['low']:.2f}, {estimate['high']:.2f}]"


def _difference(estimate: Mapping[str, float] | None) -> str:
    if estimate is None:
        return "–"
    half = "" if estimate["high"] is None else f" ±{estimate['high'] - estimate['value']:.2f}"
    return f"{estimate['value']:.2f}{half}"
