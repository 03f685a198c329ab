"""The plots of a scene, and their legends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from . import formats, plots
from .formats import Text
from .records import Record, levels


@dataclass(frozen=True)
class Legend:
    """An integrator's line in the legend of a plot; no slope if no line was fitted."""

    label: str
    series: int
    slope: Text | None


@dataclass(frozen=True)
class Chart:
    """A plot of the page.

    Attributes:
        title: The title.
        svg: The plot.
        legend: A line per integrator in the plot.
        notes: Sentences about what is and is not drawn.
    """

    title: str
    svg: Markup
    legend: list[Legend]
    notes: list[str]


def make_charts(
    scene: Record, anchor: str, series_of: Mapping[str, int], target: float | None
) -> list[Chart]:
    """Plots error against samples and seconds; with a single level, only against seconds."""
    found = levels(scene)
    axes = [("seconds", "seconds", ())]
    if len(found) > 1:
        samples = sorted({run["spp"] for one in scene["integrators"] for run in one["runs"]})
        axes.insert(0, ("spp", "samples per pixel", samples if len(samples) <= 8 else ()))
    charts = (
        _chart(scene, anchor, series_of, target, len(found) > 1, *axis) for axis in axes
    )
    return [chart for chart in charts if chart is not None]


def _chart(
    scene: Record,
    anchor: str,
    series_of: Mapping[str, int],
    target: float | None,
    has_slopes: bool,
    key: str,
    label: str,
    ticks: Sequence[float],
) -> Chart | None:
    integrators = [one for one in scene["integrators"] if one["runs"]]
    series = [
        _series(one, key, series_of[one["label"]], has_slopes) for one in integrators
    ]
    svg = plots.plot(series, label, f"{anchor}-{key}", ticks, target)
    if svg is None:
        return None
    return Chart(
        title=f"relMSE against {label}",
        svg=svg,
        legend=[
            Legend(one["label"], series_of[one["label"]], _slope(one, key) if has_slopes else None)
            for one in integrators
        ],
        notes=_notes(integrators, key, has_slopes, target),
    )


def _series(integrator: Record, key: str, index: int, has_slopes: bool) -> plots.Series:
    refused = {level["level"] for level in integrator["levels"] if level["refused"]}
    slope = integrator["slopes"].get(key) if has_slopes else None
    points = []
    for level in integrator["levels"]:
        x, y = level["figures"].get(key), level["figures"].get("relmse")
        if x and y and x["value"] is not None and y["value"] is not None:
            points.append(plots.Point(_ends(x), _ends(y)))
    return plots.Series(
        index=index,
        runs=[
            (run[key], run["relmse"])
            for run in integrator["runs"]
            if run["level"] not in refused and run["relmse"] is not None
        ],
        points=points,
        slope=slope["value"] if slope else None,
    )


def _ends(estimate: Record) -> tuple[float, float | None, float | None]:
    return estimate["value"], estimate["low"], estimate["high"]


def _slope(integrator: Record, key: str) -> Text:
    return formats.figure(integrator["slopes"].get(key), formats.plain)


def _notes(
    integrators: Sequence[Record], key: str, has_slopes: bool, target: float | None
) -> list[str]:
    first = integrators[0]["label"]
    marks = "Small marks: runs. Large marks: means with 95 % intervals."
    lines = [marks + (" Solid: fitted line." if has_slopes else "")]
    if key == "seconds":
        lines.append(f"Dotted: as efficient as {first} (error · time is constant).")
    else:
        lines.append("Dotted: slope −1, as for independent samples.")
    if target is not None:
        lines.append(f"Dashed: the target error, {formats.short(target)}.")
    below = sum(
        run["relmse"] is not None and run["relmse"] <= 0 for one in integrators
        for run in one["runs"]
    )
    if below:
        runs = f"{below} runs" if below > 1 else "one run"
        lines.append(f"Not drawn: {runs} whose error is smaller than the reference's noise.")
    if any(level["refused"] for one in integrators for level in one["levels"]):
        lines.append("Not drawn: levels whose errors were refused.")
    return lines
