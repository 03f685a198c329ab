"""Fills the template of the report."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from . import crops, formats, pictures, plots, records, tables
from .charts import make_charts
from .pictures import Picture, Pictures
from .records import Record

if TYPE_CHECKING:
    import jinja2

_FOLDER = Path(__file__).parent

_LEVELS = {
    "spp": "{} samples per pixel",
    "time": "{} s",
    "sweep": "{} samples per pixel",
    "until": "{} samples per pixel",
}


@dataclass(frozen=True)
class Crop:
    """A window cut out of one picture; ``relmse`` is the relMSE within it."""

    picture: Picture
    image: str
    relmse: str


def render_page(results: Record, folder: Path) -> str:
    """The HTML of a report. Images are read from ``folder``."""
    # In order of first appearance: each label has one colour on the whole page
    labels = dict.fromkeys(one["label"] for s in results["scenes"] for one in s["integrators"])
    series_of = {label: index % len(plots.MARKERS) for index, label in enumerate(labels)}
    scenes = [
        _scene(results, scene, f"scene-{index}", series_of, folder)
        for index, scene in enumerate(results["scenes"], 1)
    ]
    script = (_FOLDER / "report.js").read_text(encoding="utf-8")
    template = environment().get_template("report.html")
    return template.render(
        title=_title(results, list(labels)),
        facts=_facts(results),
        interrupted=results["state"] == "interrupted",
        scenes=scenes,
        labels=list(labels),
        series_of=series_of,
        glyphs=plots.GLYPHS,
        budget=results["budget"],
        color_map=pictures.COLOR_MAP,
        color_stops=_color_stops(),
        style=Markup((_FOLDER / "report.css").read_text(encoding="utf-8")),
        script=Markup(script),
        # For the page's content security policy: even if a label or a message contains HTML, only
        # this script may run, and nothing may be loaded
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


@cache  # compiles the templates once
def environment() -> jinja2.Environment:
    """The templates in this folder, with the filters that they use."""
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER, encoding="utf-8"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["number"] = formats.number
    made.filters["breakable"] = _breakable
    made.filters["short"] = formats.short
    made.filters["seconds"] = partial(formats.quantity, unit=formats.seconds)
    return made


def _breakable(label: str) -> Markup:
    """A label that can break between its parts: ``neepp:`` ``max_depth=6,`` ``grid=8``.
    """
    return Markup("<wbr>").join(re.split(r"(?<=[:,])", label))


def _scene(
    results: Record, scene: Record, anchor: str, series_of: Mapping[str, int], folder: Path
) -> dict[str, Any]:
    budget = results["budget"]
    target = budget["values"][0] if budget["kind"] == "until" and budget["values"] else None
    level = records.main_level(scene)
    found = pictures.load_pictures(scene, level, folder)
    windows = _windows(found)
    return {
        "name": scene["name"],
        "anchor": anchor,
        "facts": _scene_facts(scene),
        "problems": [
            *records.problems(scene), *(("warning", fault) for fault in found.faults)
        ],
        "integrators": {one["label"]: one for one in scene["integrators"]},
        "efficiency": {
            one["label"]: tables.ratio_cell(one, level, "efficiency")
            for one in scene["integrators"]
        },
        "level": level_name(budget, level),
        "table": tables.make_table(scene, level, target),
        "other_tables": [
            (level_name(budget, other), tables.make_table(scene, other))
            for other in reversed(records.levels(scene))
            if other != level
        ],
        "charts": make_charts(scene, anchor, series_of, target),
        "pictures": found,
        "windows": windows,
        "crops": [[_crop(picture, window) for picture in found.pictures] for window in windows],
        "color_ticks": _color_ticks(found.limits),
    }


def _title(results: Record, labels: list[str]) -> str:
    names = [scene["name"] for scene in results["scenes"]]
    place = names[0] if len(names) == 1 else f"{len(names)} scenes"
    if len(labels) > 4:
        return f"{len(labels)} integrators on {place}"
    return f"{', '.join(labels) or 'Nothing'} on {place}"


def _facts(results: Record) -> list[tuple[str, str]]:
    versions, machine = results["versions"], results["machine"]
    cores, errors = machine.get("cores"), results.get("errors")
    facts = [
        ("Budget", _budget(results)),
        ("Errors", "variances between the seeds" if errors == "between seeds" else ""),
        ("Clock", "CPU time of all threads" if results.get("clock") == "cpu" else ""),
        ("Date", str(results["date"]).replace("T", " ").replace("+00:00", " UTC")),
        ("Command", results["command"] or "(from Python)"),
        ("Machine", ", ".join(
            str(part) for part in (
                machine.get("processor"), f"{cores} cores" if cores else None,
                machine.get("system"),
            ) if part
        )),
        ("Versions", ", ".join(f"{name} {value}" for name, value in versions.items() if value)),
    ]
    return [(term, text) for term, text in facts if text]


def _budget(results: Record) -> str:
    kind, values = results["budget"]["kind"], results["budget"]["values"]
    numbers = ", ".join(formats.short(value) for value in values)
    text = {
        "spp": f"{numbers} samples per pixel",
        "time": f"{numbers} s per run",
        "sweep": f"{numbers} samples per pixel",
        "until": f"until relMSE {numbers} is reached",
    }.get(kind, f"{kind} {numbers}")
    seeds = results["seeds"]
    runs = f"{seeds} runs with different seeds" if seeds != 1 else "a single run"
    return f"{text}; {runs} of every integrator" + (" and level" if len(values) > 1 else "")


def _scene_facts(scene: Record) -> list[tuple[str, str]]:
    parameters = ", ".join(f"{key} = {value}" for key, value in scene["parameters"].items())
    settings = ", ".join(f"{key} {value}" for key, value in scene["settings"].items())
    reference = scene["reference"]
    facts = [
        ("Scene", ", ".join(filter(None, [scene["path"] or "(from Python)", parameters]))),
        ("Image", "×".join(map(str, scene["size"])) + (f", {settings}" if settings else "")),
    ]
    if reference:
        noise = reference["noise"]
        parts = [
            reference["integrator"],
            f"{reference['spp']} samples per pixel" if reference["spp"] else None,
            formats.quantity(reference["seconds"], formats.seconds)
            if reference["seconds"] else None,
            "its noise is unknown, and part of all errors" if noise is None
            else f"its own relMSE, {formats.number(noise)}, is subtracted",
        ]
        facts.append(("Reference", ", ".join(filter(None, parts))))
    return facts


def level_name(budget: Record, level: float | None) -> str:
    """A level with its unit; empty if nothing was measured."""
    if level is None:
        return ""
    return _LEVELS.get(budget["kind"], "level {}").format(formats.number(level))


def _windows(found: Pictures) -> list[crops.Window]:
    errors = [one.error for one in found.pictures if one.error is not None]
    return crops.choose_windows(errors, found.limits[0]) if found.limits else []


def _crop(picture: Picture, window: crops.Window) -> Crop:
    relmse = "" if picture.error is None else formats.number(
        float(window.cut(picture.error).mean())
    )
    return Crop(picture, pictures.png(window.cut(picture.pixels)), relmse)


def _color_stops() -> str:
    """The colour map as stops of a CSS gradient."""
    table = pictures.color_table()[:: 255 // 15]
    return ", ".join("#" + "".join(f"{part:02x}" for part in color) for color in table.tolist())


def _color_ticks(limits: tuple[float, float] | None) -> list[tuple[str, float]]:
    """The text and position (in percent) of the colour bar's ticks: both ends, and the powers of
    ten that are far enough from them."""
    if limits is None:
        return []
    low, high = np.log10(limits)
    every = int(np.ceil((high - low) / 6))
    powers = [10.0**power for power in range(int(np.ceil(low)), int(high) + 1, every)]
    between = [(value, 100 * (np.log10(value) - low) / (high - low)) for value in powers]
    ticks = [(limits[0], 0.0), *((v, p) for v, p in between if 20 < p < 85), (limits[1], 100.0)]
    return [(formats.short(value), round(float(position), 2)) for value, position in ticks]
