"""Error against cost on logarithmic axes, as SVG that takes its colours from the page.

matplotlib draws in placeholder colours, which are then replaced by variables of the style sheet.
The plot thus fits a light and a dark page, and an integrator has the same colour everywhere. The
legend is part of the page, where it can wrap.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from . import formats

#: The integrators' marks, for matplotlib and as text, which tell them apart without colour.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
GLYPHS = ("●", "■", "▲", "◆", "▼", "✚", "✖", "★")

_INK, _GRID = "#010203", "#010204"
_WIDTH, _HEIGHT = 5.6, 3.7  # inches; the page scales it

#: The maximum factor by which intervals may extend an axis beyond the points.
_INTERVAL_ROOM = 2.0

#: The minimum ratio of an axis's ends, so that tiny differences do not fill the plot.
_MIN_SPAN = 2.0


@dataclass(frozen=True)
class Point:
    """A level of an integrator: value and interval bounds, which are ``None`` for one run."""

    x: tuple[float, float | None, float | None]
    y: tuple[float, float | None, float | None]


@dataclass(frozen=True)
class Series:
    """An integrator.

    Attributes:
        index: The index of its colour and mark on the page.
        runs: Cost and error of every run.
        points: Means per level.
        slope: The slope of the line fitted to the logarithms; ``None`` draws none.
    """

    index: int
    runs: list[tuple[float, float]]
    points: list[Point]
    slope: float | None = None


def plot(
    series: Sequence[Series],
    x_label: str,
    name: str,
    x_ticks: Sequence[float] = (),
    target: float | None = None,
) -> Markup | None:
    """Draws relMSE against a cost; ``None`` if there is nothing positive to draw.

    Args:
        series: The integrators to draw. Values that are not positive are omitted.
        x_label: The name of the cost.
        name: A name for the plot that is unique on the page.
        x_ticks: The ticks of the x axis; by default, chosen by the range.
        target: The error to reach, drawn as a horizontal line.
    """
    # Imported here so that comparisons without a report do not wait for matplotlib, and not as
    # pyplot, which would change the user's figures and backend
    import matplotlib
    from matplotlib.figure import Figure

    xs = [x for one in series for x, y in _drawable(one)]
    ys = [y for one in series for x, y in _drawable(one)]
    if not xs:
        return None
    if target is not None:
        ys.append(target)
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # ignore the user's matplotlibrc
        matplotlib.rcParams.update(_STYLE)
        matplotlib.rcParams["svg.hashsalt"] = name  # ids that are the same every time
        figure = Figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
        axes = figure.add_subplot(xscale="log", yscale="log", xlabel=x_label, ylabel="relMSE")
        ends = [_ends(point.x) for one in series for point in one.points]
        axes.set_xlim(_limits(xs, ends))
        ends = [_ends(point.y) for one in series for point in one.points]
        axes.set_ylim(_limits(ys, ends))
        _set_ticks(axes.xaxis, axes.get_xlim(), x_ticks)
        _set_ticks(axes.yaxis, axes.get_ylim())
        axes.grid(color=_GRID, linewidth=0.6)
        for spine in ("top", "right"):
            axes.spines[spine].set_visible(False)
        _draw_slope_of_minus_one(axes, series[0])
        if target is not None:
            axes.axhline(target, color=_INK, linewidth=0.9, linestyle=(0, (6, 3)))
        for one in series:
            _draw(axes, one)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return Markup(_for_the_page(buffer.getvalue(), name))


def _draw(axes, series: Series) -> None:
    color, marker = _placeholder(series.index), MARKERS[series.index % len(MARKERS)]
    runs = np.array([run for run in series.runs if min(run) > 0]).reshape(-1, 2)
    axes.plot(
        *runs.T, linestyle="none", marker=marker, markersize=3.6, color=color, alpha=0.45,
        markeredgewidth=0,
    )
    low_x, high_x = axes.get_xlim()
    low_y, high_y = axes.get_ylim()
    points = [point for point in series.points if point.x[0] > 0 and point.y[0] > 0]
    for point in points:
        (x, left, right), (y, bottom, top) = point.x, point.y
        # An interval that reaches zero or below is drawn to the end of the axis
        axes.plot([max(left or x, low_x), min(right or x, high_x)], [y, y], color=color, lw=1.2)
        axes.plot([x, x], [max(bottom or y, low_y), min(top or y, high_y)], color=color, lw=1.2)
    axes.plot(
        [point.x[0] for point in points], [point.y[0] for point in points], linestyle="none",
        marker=marker, markersize=6.5, color=color, markeredgewidth=0,
    )
    if series.slope is not None and len(runs) > 1:
        # A least-squares line passes through the centre of the runs
        x, y = np.log(runs).T
        line = np.array([x.min(), x.max()])
        axes.plot(
            np.exp(line), np.exp(y.mean() + series.slope * (line - x.mean())), color=color, lw=1.2
        )


def _draw_slope_of_minus_one(axes, series: Series) -> None:
    """Draws a line of slope −1, the convergence rate of Monte Carlo, through the centre of the
    first integrator's points. Against seconds, it is also the line of equal efficiency."""
    points = [point for point in series.points if point.x[0] > 0 and point.y[0] > 0]
    if points:
        product = math.exp(sum(math.log(p.x[0] * p.y[0]) for p in points) / len(points))
        x = np.array(axes.get_xlim())
        axes.plot(x, product / x, color=_INK, linewidth=0.9, linestyle=(0, (1, 2.5)), zorder=1)


def _drawable(series: Series) -> list[tuple[float, float]]:
    pairs = [*series.runs, *((point.x[0], point.y[0]) for point in series.points)]
    return [pair for pair in pairs if min(pair) > 0]


def _ends(estimate: tuple[float, float | None, float | None]) -> list[float]:
    return [end for end in estimate[1:] if end is not None and end > 0]


def _limits(values: Sequence[float], ends: Sequence[list[float]]) -> tuple[float, float]:
    """The ends of an axis that shows all values, and the ends of intervals that are close."""
    low, high = min(values), max(values)
    for end in (end for pair in ends for end in pair):
        if low / _INTERVAL_ROOM <= end <= high * _INTERVAL_ROOM:
            low, high = min(low, end), max(high, end)
    room = max(1.15, math.sqrt(_MIN_SPAN * low / high), (high / low) ** 0.06)
    return low / room, high * room


def _set_ticks(axis, limits: tuple[float, float], wanted: Sequence[float] = ()) -> None:
    """Ticks at round numbers: matplotlib's own choice leaves short axes without labels."""
    from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

    ticks = [tick for tick in wanted or _round_numbers(*limits) if limits[0] <= tick <= limits[1]]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FixedFormatter([formats.short(tick) for tick in ticks]))
    axis.set_minor_locator(NullLocator())


def _round_numbers(low: float, high: float) -> list[float]:
    from matplotlib.ticker import MaxNLocator

    decades = math.log10(high / low)
    if decades < 0.7:
        return list(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    factors = (1, 2, 5) if decades < 2 else (1, 3) if decades < 3.5 else (1,)
    every = max(1, math.ceil(decades / 8))
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1, every)
    return [factor * 10.0**power for power in powers for factor in factors]


def _placeholder(index: int) -> str:
    return f"#0102{16 + index % len(MARKERS):02x}"


def _for_the_page(svg: str, name: str) -> str:
    """Makes an ``<svg>`` that can share an HTML page with others."""
    svg = svg[svg.index("<svg") :]  # without the XML declaration and the DTD
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # This style would apply to the whole page; report.css has the same rules for plots only
    svg = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    # matplotlib counts its ids from 1 in every figure
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'href="#', f'href="#{name}-', svg)
    svg = re.sub(r"url\(#", f"url(#{name}-", svg)
    svg = re.sub(r"'DejaVu Sans'[^;\"]*sans-serif", "var(--font)", svg)
    svg = svg.replace(_INK, "var(--ink)").replace(_GRID, "var(--line)")
    for index in range(len(MARKERS)):
        svg = svg.replace(_placeholder(index), f"var(--series-{index})")
    return svg.replace("<svg", '<svg aria-hidden="true"', 1)


_STYLE = {
    "svg.fonttype": "none",  # text stays text, which can be selected and has the page's font
    "font.size": 10.5,
    "text.color": _INK,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}
