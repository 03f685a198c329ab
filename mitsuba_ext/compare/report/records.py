"""Reads ``results.json`` for the report, and chooses the runs and the level to show.

A *level* is the size of a run: samples per pixel, or seconds. Only equal levels are compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ...util.errors import InputError

#: The schema of ``results.json`` that this report can read.
SCHEMA = 2

Record = Mapping[str, Any]


def read_results(folder: Path) -> Record:
    """The content of ``folder/results.json``.

    Raises:
        InputError: The file is missing, is not JSON, or has another schema.
    """
    path = folder / "results.json"
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({error})") from error
    found = results.get("schema") if isinstance(results, dict) else None
    if found != SCHEMA:
        raise InputError(f"{path}: is of schema {found}, this version reads schema {SCHEMA}")
    return results


def levels(scene: Record) -> list[float]:
    """All levels at which something was measured, ascending."""
    return sorted({level["level"] for one in scene["integrators"] for level in one["levels"]})


def main_level(scene: Record) -> float | None:
    """The largest level that every integrator with runs has, so that the main table is fair;
    without one, the largest of all; ``None`` if nothing was measured."""
    measured = [
        {level["level"] for level in integrator["levels"]}
        for integrator in scene["integrators"]
        if integrator["levels"]
    ]
    if not measured:
        return None
    return max(set.intersection(*measured) or set.union(*measured))


def at_level(integrator: Record, level: float | None) -> Record | None:
    """The record of one level; ``None`` if the integrator was not measured there."""
    return next((one for one in integrator["levels"] if one["level"] == level), None)


def runs_at(integrator: Record, level: float | None) -> list[Record]:
    """The runs of one level, in the order of their rounds, in which integrators share seeds."""
    runs = [run for run in integrator["runs"] if run["level"] == level]
    return sorted(runs, key=lambda run: run["round"])


def pictured_runs(integrator: Record, level: float | None) -> list[Record]:
    """The runs whose images are shown: runs of ``level``, or of the largest measured level if the
    integrator was stopped before ``level``."""
    runs = runs_at(integrator, level)
    if not runs and integrator["runs"]:
        runs = runs_at(integrator, max(run["level"] for run in integrator["runs"]))
    return runs


def problems(scene: Record) -> Iterator[tuple[str, str]]:
    """Errors, warnings and notes of a scene: pairs of ``"error"`` or ``"warning"`` and a sentence,
    without repetitions."""
    seen = set()
    for kind, text in _problems(scene):
        if text not in seen:
            seen.add(text)
            yield kind, text


def _problems(scene: Record) -> Iterator[tuple[str, str]]:
    if scene["error"]:
        yield "error", f"not measured: {scene['error']}"
    for warning in scene["warnings"]:
        yield "warning", warning
    for integrator in scene["integrators"]:
        label = integrator["label"]
        if integrator["error"]:
            after = f" after {len(integrator['runs'])} runs" if integrator["runs"] else ""
            yield "error", f"{label} failed{after}: {integrator['error']}"
        for note in integrator["notes"]:
            yield "warning", f"{label}: {note}"
        for level in integrator["levels"]:
            # A note may already contain the same text
            if level["refused"] and not any(level["refused"] in n for n in integrator["notes"]):
                yield "warning", f"{label}: no errors at level {level['level']:g}: " + (
                    level["refused"]
                )
