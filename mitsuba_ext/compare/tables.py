"""The results of a comparison on the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

_ERRORS = (
    ("relMSE", "relmse"), ("trimmed", "relmse_trimmed"), ("σ/μ", "sigma_mu"), ("FLIP", "flip"),
)

_LEGEND = (
    "Means over the rounds (seconds: median), with 95 % confidence intervals over them (as a "
    "factor: +50 % upwards is −33 % downwards); compilation excluded, learning included. "
    "eff. = 1 / (relMSE · seconds), relative to the first; shadow = shadow rays traced, of those "
    "that 'path' would trace."
)


#: On narrower terminals, only the most important figures are shown.
_FULL_WIDTH = 140

#: Width of what goes to a file or a pipe, where there is no terminal to ask.
_PIPE_WIDTH = 160


def show(results: Mapping[str, Any]) -> None:
    """Prints a table for each scene, with what a reader has to know to trust it.

    Args:
        results: The content of ``results.json``.
    """
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PIPE_WIDTH)
    for part in tables(results, console.width):
        console.print(part, highlight=False, soft_wrap=isinstance(part, Text))


def tables(results: Mapping[str, Any], width: int = _FULL_WIDTH) -> Iterator[Table | Text]:
    """What :func:`show` prints, for ``width`` characters."""
    for scene in results["scenes"]:
        if scene["error"]:
            yield Text(f"{scene['name']}: {scene['error']}\n", style="red")
            continue
        yield _scene_table(scene, results["budget"], width < _FULL_WIDTH)
        yield Text("\n".join(_notes(scene)) + "\n")
    yield Text(_LEGEND)


def _scene_table(scene: Mapping[str, Any], budget: Mapping[str, Any], is_narrow: bool) -> Table:
    table = Table(
        title=_title(scene, budget), title_justify="left", title_style="", box=box.SIMPLE_HEAD,
        show_edge=False, padding=(0, 1, 0, 0),
    )
    table.add_column("integrator", overflow="fold", min_width=12)
    has_levels = budget["kind"] in ("sweep", "until")
    errors = _ERRORS[:1] if is_narrow else _ERRORS
    headings = [*(heading for heading, _ in errors), "spp", "seconds", "shadow", "eff."]
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
            *(_number(figures[name], not is_narrow) for _, name in errors),
            f"{figures['spp']['value']:.6g}",
            _number(figures["seconds"], not is_narrow),
            _percent(figures["shadow_share"]),
            _ratio(level["ratios"]["efficiency"]),
        ]
        if has_levels:
            row.append(_difference(contender["slopes"]["spp"]))
        if budget["kind"] == "until":
            row.append(_number((contender["target"] or {}).get("seconds"), not is_narrow))
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


def _number(estimate: Mapping[str, float] | None, with_interval: bool) -> str:
    if estimate is None:
        return "–"
    value, high = estimate["value"], estimate["high"]
    if not with_interval or high is None or not value > 0:
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
