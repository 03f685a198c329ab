"""Makes a table of the figures of one level; columns without figures are omitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from . import formats
from .formats import Text, Unit
from .records import Record, at_level


@dataclass(frozen=True)
class Column:
    """A column of the table.

    Attributes:
        heading: The heading.
        unit: The unit in which its values are printed.
        estimate: A function of an integrator and its level that returns the figure, or ``None``.
        explanation: A tooltip.
        group: The common heading of this column and its neighbours.
    """

    heading: str
    unit: Unit
    estimate: Callable[[Record, Record], Mapping[str, float | None] | None]
    explanation: str
    group: str


@dataclass(frozen=True)
class Cell:
    """A figure; ``differs`` marks a ratio whose interval does not contain 1."""

    text: Text
    differs: bool = False


@dataclass(frozen=True)
class Table:
    """A table: columns in groups, and a row of cells per integrator.

    Attributes:
        groups: The heading and the number of columns of each group.
        columns: The columns that are not empty.
        rows: An integrator of ``results.json`` and its cells; no cells if it was not measured.
        unrecorded: The headings of the omitted columns.
    """

    groups: list[tuple[str, int]]
    columns: list[Column]
    rows: list[tuple[Record, list[Cell]]]
    unrecorded: list[str]


def make_table(
    scene: Record,
    level: float | None,
    target: float | None = None,
    wanted: Callable[[Column], bool] = lambda _column: True,
) -> Table:
    """The table of one level.

    Args:
        target: The relMSE of ``until``; ``None`` for other budgets.
        wanted: A function that says whether to make a column.
    """
    integrators = scene["integrators"]
    rows = [(integrator, at_level(integrator, level)) for integrator in integrators]
    columns = [*_ratios(integrators), *_target(target), *_RUN, *_ERRORS, *_WORK]
    used = [
        column
        for column in filter(wanted, columns)
        if any(record and column.estimate(one, record) for one, record in rows)
    ]
    groups: list[tuple[str, int]] = []
    for column in used:
        if groups and groups[-1][0] == column.group:
            groups[-1] = (column.group, groups[-1][1] + 1)
        else:
            groups.append((column.group, 1))
    return Table(
        groups=groups,
        columns=used,
        rows=[
            (one, [_cell(column, one, record) for column in used] if record else [])
            for one, record in rows
        ],
        unrecorded=[one.heading for one in (*_RUN, *_ERRORS, *_WORK) if one not in used],
    )


def ratio_cell(integrator: Record, level: float | None, name: str) -> Cell:
    """One ratio to the first integrator, for the overview of all scenes."""
    record = at_level(integrator, level)
    estimate = record["ratios"].get(name) if record else None
    return Cell(formats.figure(estimate, formats.times), _differs_from_one(estimate))


def _cell(column: Column, integrator: Record, level: Record) -> Cell:
    estimate = column.estimate(integrator, level)
    is_ratio = column.unit is formats.times
    return Cell(formats.figure(estimate, column.unit), is_ratio and _differs_from_one(estimate))


def _differs_from_one(estimate: Mapping[str, float | None] | None) -> bool:
    if not estimate or estimate["low"] is None or estimate["high"] is None:
        return False
    return estimate["low"] > 1 or estimate["high"] < 1


def _figure(heading: str, unit: Unit, key: str, explanation: str, group: str) -> Column:
    return Column(
        heading, unit, lambda _integrator, level: level["figures"].get(key), explanation, group
    )


def _ratios(integrators: list[Record]) -> list[Column]:
    if len(integrators) < 2:
        return []
    group = f"relative to {integrators[0]['label']}"

    def ratio(heading: str, key: str, explanation: str) -> Column:
        return Column(
            heading, formats.times, lambda _one, level: level["ratios"].get(key), explanation, group
        )

    return [
        ratio("efficiency", "efficiency", "1 / (relMSE · seconds): more is better"),
        ratio("time", "seconds", "Less is better"),
        ratio("relMSE", "relmse", "Less is better"),
        ratio("trimmed", "relmse_trimmed", "relMSE without the largest 0.1 %: less is better"),
        ratio("mean", "mean", "The mean of the image: without bias, it is 1"),
    ]


def _target(target: float | None) -> list[Column]:
    if target is None:
        return []
    group = f"to reach relMSE {formats.short(target)}"

    def cost(heading: str, key: str, unit: Unit) -> Column:
        return Column(
            heading, unit, lambda one, _level: (one.get("target") or {}).get(key),
            "From the fitted line of the convergence", group,
        )

    return [cost("samples", "spp", formats.plain), cost("time", "seconds", formats.seconds)]


def _compilation(integrator: Record, _level: Record) -> Mapping[str, float | None] | None:
    seconds = integrator["compile_seconds"]
    return None if seconds is None else {"value": seconds, "low": None, "high": None}


_RUN = [
    _figure("time", formats.seconds, "seconds", "Includes learning, not compilation", "run"),
    _figure("samples", formats.plain, "spp", "Samples per pixel", "run"),
]

_ERRORS = [
    _figure("relMSE", formats.plain, "relmse", "Mean of (I − R)² / (R² + ε)", "error"),
    _figure(
        "trimmed", formats.plain, "relmse_trimmed",
        "relMSE without the 0.1 % of the pixels with the largest errors", "error",
    ),
    _figure(
        "99 %", formats.plain, "relmse_worst", "99th percentile of the relative errors of pixels",
        "error",
    ),
    _figure("rMSE", formats.plain, "rmse", "√ of the mean squared error", "error"),
    _figure("σ/μ", formats.plain, "sigma_mu", "Coefficient of variation, Cline (4.13)", "error"),
    _figure("FLIP", formats.plain, "flip", "Perceived difference (HDR), from 0 to 1", "error"),
]

_WORK = [
    _figure("rays", formats.count, "rays", "Camera, scatter and shadow rays of one run", "work"),
    _figure("scatter", formats.count, "rays_scatter", "Rays sampled by a BSDF", "work"),
    _figure("shadow", formats.count, "rays_shadow", "Shadow rays that were traced", "work"),
    _figure(
        "shadow share", formats.percent, "shadow_share",
        "Shadow rays traced, as a percentage of the connections to lights", "work",
    ),
    _figure(
        "zero", formats.percent, "zero_radiance", "Camera samples without light", "work"
    ),
    _figure("memory", formats.byte_count, "memory", "Peak of one run", "work"),
    _figure("launches", formats.plain, "launches", "Kernel launches of one run", "work"),
    Column(
        "compilation", formats.seconds, _compilation,
        "Before the measured runs, not part of their time", "work",
    ),
]
