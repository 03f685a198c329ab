"""The short form of the report, for notebooks: a table with thumbnails for each scene."""

from __future__ import annotations

import base64
import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...images import metrics, reading
from ...util.errors import InputError
from . import pictures, records, tables
from .page import environment, level_name
from .records import Record
from .tables import Column

#: The maximum width and height of a thumbnail. Its JPEG has about 10 kB; 30 kB if it is all noise.
THUMBNAIL = (160, 120)

#: Headings of the columns that are not ratios.
_HEADINGS = {"time", "samples", "relMSE", "FLIP"}


def render_summary(results: Record, folder: Path) -> str:
    """HTML without styles and scripts.

    Args:
        results: The content of ``results.json``.
        folder: The folder of its images. Missing images are omitted.
    """
    scenes = [_scene(results, scene, folder) for scene in results["scenes"]]
    return environment().get_template("summary.html").render(
        scenes=scenes, interrupted=results["state"] == "interrupted"
    )


def _scene(results: Record, scene: Record, folder: Path) -> dict[str, Any]:
    budget = results["budget"]
    target = budget["values"][0] if budget["kind"] == "until" and budget["values"] else None
    level = records.main_level(scene)
    return {
        "name": scene["name"],
        "level": level_name(budget, level),
        "problems": list(records.problems(scene)),
        "table": tables.make_table(scene, level, target, _is_short),
        "images": dict(_thumbnails(scene, level, folder)),
    }


def _is_short(column: Column) -> bool:
    is_ratio = column.group.startswith("relative to")
    return column.heading == "efficiency" if is_ratio else column.heading in _HEADINGS


def _thumbnails(scene: Record, level: float | None, folder: Path) -> Iterator[tuple[str, str]]:
    """The first image of each integrator, all with the same exposure: pairs of label and URI."""
    found: dict[str, np.ndarray] = {}
    for one in scene["integrators"]:
        for run in records.pictured_runs(one, level)[:1]:
            with contextlib.suppress(InputError):
                found[one["label"]] = _read(folder / run["image"])
    exposed = list(found.values())[:1]
    if scene["reference"]:
        with contextlib.suppress(InputError):
            exposed = [_read(folder / scene["reference"]["path"])]
    for label, pixels in found.items():
        yield label, thumbnail(pictures.tone_map(pixels, pictures.exposure(exposed[0])))


def _read(path: Path) -> np.ndarray:
    pixels = reading.read_image(path)[0].astype(np.float64)
    if fault := metrics.describe_non_finite(pixels):
        raise InputError(f"{path}: {fault}")
    return pixels


def thumbnail(pixels: np.ndarray) -> str:
    """A small JPEG of 8-bit sRGB as a ``data:`` URI of less than 50 kB."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(pixels))
    image.thumbnail(THUMBNAIL)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=80)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
