"""Prints the results of a comparison on the terminal."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

#: Column headings and figures.
_ERRORS = (
    ("relMSE", "relmse"), ("trimmed", "relmse_trimmed"), ("σ/μ", "sigma_mu"), ("FLIP", "flip"),
)
_BETWEEN_SEEDS = (*_ERRORS[:3], ("99 %", "relmse_worst"))

_LEGEND = (
    "Means over the rounds (seconds: medians) with 95 % confidence intervals, given as factors: "
    "+50 % upwards is −33 % downwards. Times include learning, not compilation. "
    "eff. = 1 / (relMSE · seconds), relative to the first integrator; shadow = share of the shadow "
    "rays of 'path' that are traced."
)
_LEGEND_BETWEEN_SEEDS = (
    " Errors are variances between the seeds, without bias: it shows in the mean of the image, "
    "relative to the first integrator. 99 % = percentile of the errors of pixels; trimmed eff. = "
    "1 / (trimmed · seconds)."
)
_LEGEND_CPU = " Seconds are CPU time of all threads."

#: The width of the output to a file or a pipe, in characters.
_PIPE_WIDTH = 160

#: The minimum width of labels, in characters; columns that do not fit go to another table.
_LABEL_WIDTH = 16


def show(results: Mapping[str, Any]) -> None:
    """Prints a table for each scene, with its reference, warnings and notes. If the terminal is too
    narrow for all columns, a scene has several tables.

    Args:
        results: The content of ``results.json``.
    """
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PIPE_WIDTH)
    for part in tables(results, console.width):
        console.print(part, highlight=False, soft_wrap=isinstance(part, Text))


def tables(results: Mapping[str, Any], width: int = _PIPE_WIDTH) -> Iterator[Table | Text]:
    """The parts printed by :func:`show`, laid out for ``width`` characters."""
    for scene in results["scenes"]:
        if scene["error"]:
            yield Text(f"{scene['name']}: {scene['error']}\n", style="red")
            continue
        title = _title(scene, results["budget"])
        labels = [contender["label"] for contender in scene["integrators"]]
        groups = _in_groups(_columns(scene, results), labels, width)
        for index, columns in enumerate(groups):
            yield Text("" if index else title)
            yield _table(labels, columns, width)
        for contender in scene["integrators"]:
            if contender["error"]:
                yield Text(f"{contender['label']}: {contender['error']}", style="red")
        yield Text("\n".join(_notes(scene)) + "\n")
    legend = _LEGEND + _LEGEND_BETWEEN_SEEDS * _has_no_reference(results)
    yield Text(legend + _LEGEND_CPU * (results.get("clock") == "cpu"))


def _has_no_reference(results: Mapping[str, Any]) -> bool:
    return results.get("errors") == "between seeds"


class _Column(NamedTuple):
    heading: str
    cells: list[str]

    @property
    def width(self) -> int:
        """The width including the two spaces before the column."""
        return 2 + max(cell_len(text) for text in (self.heading, *self.cells))


def _columns(scene: Mapping[str, Any], results: Mapping[str, Any]) -> list[_Column]:
    """The figures at the largest level of each integrator."""
    budget, has_no_reference = results["budget"], _has_no_reference(results)
    makers: dict[str, Callable[[Mapping[str, Any], Mapping[str, Any]], str]] = {
        **{
            heading: lambda _contender, level, name=name: _number(level["figures"][name])
            for heading, name in (_BETWEEN_SEEDS if has_no_reference else _ERRORS)
        },
        "spp": lambda _contender, level: f"{level['figures']['spp']['value']:.6g}",
        "seconds": lambda _contender, level: _number(level["figures"]["seconds"]),
        "shadow": lambda _contender, level: _percent(level["figures"]["shadow_share"]),
        "eff.": lambda _contender, level: _ratio(level["ratios"]["efficiency"]),
    }
    if has_no_reference:
        makers["trimmed eff."] = lambda _contender, level: _ratio(
            level["ratios"]["efficiency_trimmed"]
        )
        makers["mean"] = lambda _contender, level: _ratio(level["ratios"]["mean"])
    if budget["kind"] in ("sweep", "until"):
        makers["slope"] = lambda contender, _level: _difference(contender["slopes"]["spp"])
    if budget["kind"] == "until":
        makers["s to target"] = lambda contender, _level: _number(
            (contender["target"] or {}).get("seconds")
        )
    return [
        _Column(heading, [
            make(contender, contender["levels"][-1]) if contender["levels"] else "–"
            for contender in scene["integrators"]
        ])
        for heading, make in makers.items()
    ]


def _in_groups(
    columns: Sequence[_Column], labels: Sequence[str], width: int
) -> Iterator[list[_Column]]:
    """The columns of each table: one table if all columns fit beside the labels, otherwise separate
    tables for errors and for costs, split further if needed."""
    room = width - min(_LABEL_WIDTH, max(map(cell_len, labels), default=0))
    if sum(column.width for column in columns) <= room:
        yield list(columns)
        return
    for part in (columns[: len(_ERRORS)], columns[len(_ERRORS) :]):
        group: list[_Column] = []
        for column in part:
            if group and sum(other.width for other in (*group, column)) > room:
                yield group
                group = []
            group.append(column)
        yield group


def _table(labels: Sequence[str], columns: Sequence[_Column], width: int) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), pad_edge=False
    )
    room = max(_LABEL_WIDTH, width - sum(column.width for column in columns))
    table.add_column("integrator", overflow="fold")
    for column in columns:
        table.add_column(column.heading, justify="right", no_wrap=True)
    for index, label in enumerate(labels):
        text = Text("\n".join(_broken(label, room)))
        table.add_row(text, *(column.cells[index] for column in columns))
    return table


def _broken(label: str, width: int) -> Iterator[str]:
    """The lines of a label, broken after commas and brackets where possible."""
    line = ""
    for piece in re.split(r"(?<=[,\[])", label):
        if line and cell_len(line + piece) > width:
            yield line
            line = "  "
        line += piece
    yield line


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
        note = "" if noise is None else f" (its own relMSE, {noise:.2g}, is subtracted)"
        yield f"Reference: {reference['path']}{note}."
    for warning in scene["warnings"]:
        yield f"Warning: {warning}."
    for contender in scene["integrators"]:
        if learned := contender["runs"] and contender["runs"][-1].get("learned"):
            yield f"{contender['label']} learned in its last run: {learned}."
        for note in contender["notes"]:
            yield f"{contender['label']}: {note}."
        for level in contender["levels"]:
            if level["refused"]:
                yield f"{contender['label']} at {level['level']:g}: {level['refused']}."


def _number(estimate: Mapping[str, float] | None) -> str:
    if estimate is None:
        return "–"
    value, high = estimate["value"], estimate["high"]
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
