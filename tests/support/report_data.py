"""Synthetic folders of comparisons: images of a known reference with noise of a known variance."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_ext.compare import write_report
from mitsuba_ext.images import metrics
from mitsuba_ext.images.image_files import write_exr

HOSTILE = '<script>alert(1)</script>"\'&'
REFUSAL = "the reference is too noisy: its own relMSE is 0.1"


def estimate(value: float | None, spread: float = 0.1) -> dict[str, float] | None:
    if value is None:
        return None
    return {"value": value, "low": value - spread * abs(value), "high": value + spread * abs(value)}


def make_integrator(
    folder: Path, label: str, scene: str, reference: np.ndarray, noise: float, levels: list[int]
) -> dict[str, Any]:
    """An integrator with two runs per level, whose images are the reference with noise."""
    rng = np.random.default_rng(len(label))
    runs = []
    for level in levels:
        for seed in range(2):
            scale = noise / level**0.5
            image = reference * (1 + scale * rng.standard_normal(reference.shape))
            name = f"{scene}/{re.sub(r'[^a-z]', '_', label)}_{level}_{seed}.exr"
            (folder / scene).mkdir(exist_ok=True)
            write_exr(folder / name, image, "RGB", {})
            runs.append({
                "level": level, "seed": seed, "round": seed, "spp": level,
                "seconds": level / 100 + 0.01 * seed,
                "relmse": metrics.relative_mse(image, reference), "relmse_trimmed": scale**2,
                "mse": scale**2, "rmse": scale, "sigma_mu": scale, "flip": None,
                "rays": {}, "connections": None, "zero_radiance": None, "memory": None,
                "launches": None, "image": name,
            })
    unknown = dict.fromkeys(("rays", "shadow_share", "zero_radiance", "memory", "launches"))
    return {
        "label": label, "name": "path", "parameters": {}, "error": "", "notes": [],
        "compile_seconds": 0.5, "runs": runs,
        "levels": [
            {
                "level": level, "run_count": 2, "refused": "",
                "figures": {
                    "spp": estimate(level, 0), "seconds": estimate(level / 100),
                    **dict.fromkeys(
                        ("relmse", "relmse_trimmed", "mse", "rmse", "sigma_mu"),
                        estimate(noise**2 / level),
                    ),
                    "flip": None, "efficiency": estimate(100 / noise**2), **unknown,
                },
                "ratios": dict.fromkeys(
                    ("seconds", "relmse", "relmse_trimmed", "efficiency"), estimate(1 / noise)
                ),
            }
            for level in levels
        ],
        "slopes": dict.fromkeys(("spp", "seconds"), estimate(-1) if len(levels) > 1 else None),
        "target": None,
    }


def make_scene(
    folder: Path, name: str, size: tuple[int, int], levels: list[int], labels: list[str]
) -> dict[str, Any]:
    width, height = size
    y, x = np.mgrid[:height, :width]
    reference = np.stack([1 + x, 1 + y, 1 + x + y], axis=2) / (width + height)
    (folder / "references").mkdir(exist_ok=True)
    write_exr(folder / f"references/{name}.exr", reference, "RGB", {})
    return {
        "name": name, "path": f"/scenes/{name}.xml", "parameters": {}, "content_hash": "0",
        "size": [width, height], "settings": {"max_depth": 6}, "error": "", "warnings": [],
        "reference": {
            "path": f"references/{name}.exr", "noise": None, "spp": None, "integrator": None,
            "seconds": None, "metadata": {},
        },
        "integrators": [
            make_integrator(folder, label, name, reference, 1 / (1 + index), levels)
            for index, label in enumerate(labels)
        ],
    }


def make_results(scenes: list[dict[str, Any]], kind: str, values: list[float]) -> dict[str, Any]:
    return {
        "schema": 2, "date": "2026-01-02T03:04:05+00:00", "command": "mitsuba-ext compare …",
        "state": "finished", "budget": {"kind": kind, "values": values}, "seeds": 2,
        "scenes": scenes, "versions": {"mitsuba": "3.9.1"},
        "machine": {"system": "Linux", "processor": "a processor", "cores": 2},
    }


def write(folder: Path, results: dict[str, Any]) -> str:
    """Writes the results and their report; the HTML."""
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    path = write_report(folder)
    assert path == folder / "report.html"
    return path.read_text(encoding="utf-8")


def write_full(folder: Path) -> Path:
    """Writes a folder with a report of everything that can happen in one comparison."""
    large = make_scene(folder, "large", (96, 64), [4, 16, 64], ["path", HOSTILE, "better"])
    large["integrators"][1]["levels"][0].update(refused=REFUSAL)
    for name in ("relmse", "relmse_trimmed", "mse", "rmse", "sigma_mu"):
        large["integrators"][1]["levels"][0]["figures"][name] = None
    large["warnings"] = ["the reference has max_depth 6, the scene 8"]
    broken = make_integrator(folder, "broken", "large", np.ones((64, 96, 3)), 1.0, [])
    broken["error"] = f"out of memory {HOSTILE}"
    large["integrators"].append(broken)
    tiny = make_scene(folder, "tiny", (1, 1), [4, 16, 64], ["path", "better"])
    bad = make_scene(folder, "bad", (8, 8), [], [])
    bad.update(error="bad.xml: no such scene", reference=None)
    results = make_results([large, tiny, bad], "sweep", [4, 16, 64])
    write(folder, {**results, "state": "interrupted"})
    return folder
