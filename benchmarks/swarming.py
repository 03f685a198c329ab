"""Measures maps of samples that pixels share, as Table 9.2 of Cline's dissertation does:
``nice .venv/bin/python benchmarks/swarming.py`` (half an hour; ``--width 640`` takes two).

For each map, one scene or two: the standard deviation of pixels over the mean of the image (σ/μ),
from independent seeds, of plain paths, of paths with a ``multijitter`` sampler, of the technique of
ours that takes the same decision, of ``swarm_path`` with this map alone, and with all maps; at
equal numbers of samples, and at equal CPU time. The methods take turns; times are medians of user
and system time of all threads, kernels are compiled beforehand, and all learning is included.

Results go to ``out/swarming/WIDTH.json``; ``--plot`` draws those of the given width and writes
``docs/figures/swarming_WIDTH.svg``, with ``--plot --keep`` without measuring.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from equal_samples import TRIMMED, render_in_turns

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).parents[1]
OUT, FIGURES = ROOT / "out/swarming", ROOT / "docs/figures"

#: All maps of ``swarm_path``.
MAPS = (
    "time_map", "lens_map", "wavelength_map", "distance_map", "light_map", "lobe_map",
    "direction_map",
)  # fmt: skip


class Case(NamedTuple):
    """A row of the table.

    Attributes:
        scene, depth, spp: What is rendered.
        map: The parameter of ``swarm_path`` that is measured.
        rival: The technique of ours that takes the same decision.
        gain: By what factor σ/μ falls in the source, if it has this map.
        variant: Of Mitsuba.
    """

    scene: str
    depth: int
    spp: int
    map: str
    rival: str
    gain: float | None = None
    variant: str = "llvm_ad_rgb"


CASES = {
    "time": Case("six_balls", 2, 16, "time_map", "reweighted_time", 5.0),
    "lens": Case("colour_wheel", 2, 32, "lens_map", "reweighted_lens", 5.9),
    "direction": Case("burning_glass", 5, 32, "direction_map", "pss_guided", 2.5),
    "direction, card": Case("bounce_card", 4, 64, "direction_map", "pss_guided"),
    "light selection": Case("spotlights", 3, 6, "light_map", "neepp", 2.9),
    "bifurcation": Case("peppers_ghost", 8, 16, "lobe_map", "pss_guided", 4.3),
    "bifurcation, panes": Case("panes", 8, 32, "lobe_map", "pss_guided"),
    "distance": Case("fog", 2, 32, "distance_map", "neepp", 3.3),
    "point on light": Case("showroom", 3, 32, "light_map", "neepp", 2.6),
    "wavelength": Case(
        "discharge_lamps", 4, 32, "wavelength_map", "reweighted_wavelength",
        variant="llvm_ad_spectral",
    ),
    "several": Case("paperweight", 10, 64, "lens_map", "auto_path"),
}  # fmt: skip

#: Names of the methods, in the order of the turns.
METHODS = ("path", "multijitter", "rival", "map", "all maps")


def integrator_of(case: Case, method: str) -> mi.Integrator:
    """The integrator of one of the METHODS."""
    depth = {"max_depth": case.depth}
    if method in ("path", "multijitter"):
        return mi.load_dict({"type": "composed_path", **depth})
    if method == "rival":
        if case.rival.startswith("reweighted_"):
            return mi.load_dict({"type": case.rival, "nested": {"type": "composed_path", **depth}})
        return mi.load_dict({"type": case.rival, **depth})
    on = {name: method == "all maps" or name == case.map for name in MAPS}
    return mi.load_dict({"type": "swarm_path", **on, **depth})


def trimmed(variance: np.ndarray) -> float:
    """The mean without the largest 0.1 %."""
    values = np.sort(variance.ravel())
    return float(values[: len(values) - int(TRIMMED * len(values))].mean())


def measure(case: Case, width: int, seeds: int) -> dict[str, dict[str, Any]]:
    """σ/μ, σ/μ without the largest 0.1 % of the variances, and CPU seconds, of each method."""
    mi.set_variant(case.variant)
    mi.set_log_level(mi.LogLevel.Error)
    file, size = str(ROOT / f"scenes/{case.scene}.xml"), {"width": width, "height": width * 9 // 16}
    scenes = {
        sampler: mi.load_file(file, sampler=sampler, **size)
        for sampler in ("independent", "multijitter")
    }
    jobs = {
        method: (scenes.get(method, scenes["independent"]), integrator_of(case, method), case.spp)
        for method in METHODS
    }
    renders = render_in_turns(jobs, seeds)
    mean = np.mean([found.mean for found in renders.values()])
    return {
        method: {
            "sigma": float(np.sqrt(found.variance.mean()) / mean),
            "trimmed": float(np.sqrt(trimmed(found.variance)) / mean),
            "seconds": found.time,
            "mean": float(found.mean.mean() / mean),
            "learned": found.learned[-1],
        }
        for method, found in renders.items()
    }


def gains(results: dict[str, dict[str, Any]], method: str) -> tuple[float, float, float]:
    """By what factors σ/μ falls: at equal samples, the same without the largest variances, and at
    equal time."""
    plain, own = results["path"], results[method]
    gain = plain["sigma"] / own["sigma"]
    return (
        gain,
        plain["trimmed"] / own["trimmed"],
        gain * np.sqrt(plain["seconds"] / own["seconds"]),
    )


def report(name: str, case: Case, results: dict[str, dict[str, Any]]) -> None:
    """Prints one row."""
    source = f"; the source: {case.gain}" if case.gain else ""
    print(f"{name} ({case.scene}, {case.spp} samples{source})")
    for method in METHODS:
        equal, cut, time = gains(results, method)
        shown, own = case.rival if method == "rival" else method, results[method]
        print(
            f"  {shown}: σ/μ {own['sigma']:.3f}, {own['seconds']:.2f} CPU s, gain {equal:.2f} "
            f"(trimmed {cut:.2f}) at equal samples, {time:.2f} at equal time, mean "
            f"{own['mean']:.4f}",
            flush=True,
        )
    print(f"  {results['all maps']['learned']}", flush=True)


def plot(results: dict[str, dict[str, dict[str, Any]]], path: Path) -> None:
    """Gains by map, as bars."""
    from matplotlib import pyplot as plt

    kinds = {
        "Cline 2007": lambda name, r: CASES[name].gain or np.nan,
        "map, equal samples": lambda name, r: gains(r, "map")[0],
        "map, equal time": lambda name, r: gains(r, "map")[2],
        "all maps, equal samples": lambda name, r: gains(r, "all maps")[0],
        "multijitter, equal samples": lambda name, r: gains(r, "multijitter")[0],
        "our other technique, equal samples": lambda name, r: gains(r, "rival")[0],
        "our other technique, equal time": lambda name, r: gains(r, "rival")[2],
    }
    colours = ("0.75", "tab:blue", "lightskyblue", "navy", "tab:orange", "tab:green", "lightgreen")
    names = [name for name in CASES if name in results]
    figure, axes = plt.subplots(figsize=(11, 4), layout="constrained")
    bar = 0.84 / len(kinds)
    for k, ((label, value), colour) in enumerate(zip(kinds.items(), colours)):
        x = np.arange(len(names)) + (k - (len(kinds) - 1) / 2) * bar
        heights = [value(n, results[n]) - 1 for n in names]
        axes.bar(x, heights, bar, bottom=1, label=label, color=colour)
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_ylim(0.4, 10)
    axes.set_yticks([0.5, 1, 2, 4, 8], ["1/2", "1", "2", "4", "8"])
    axes.set_yticks([], minor=True)
    labels = [f"{n}\n{CASES[n].scene}, {CASES[n].spp}" for n in names]
    axes.set_xticks(range(len(names)), labels, fontsize=7)
    axes.set_ylabel("σ/μ of path over that of the method")
    figure.legend(fontsize=7, ncols=4, loc="outside upper center")
    figure.savefig(path)


@click.command()
@click.argument("names", nargs=-1, type=click.Choice(list(CASES)))
@click.option("--width", default=320, show_default=True)
@click.option("--seeds", default=4, show_default=True)
@click.option("--plot", "draws", is_flag=True, help="Draw the results of this width.")
@click.option("--keep", is_flag=True, help="Measure nothing.")
def main(names: tuple[str, ...], width: int, seeds: int, draws: bool, keep: bool) -> None:
    """Measures the maps NAMES (all, if none is given)."""
    OUT.mkdir(parents=True, exist_ok=True)
    path = OUT / f"{width}.json"
    results = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name in () if keep else names or CASES:
        results[name] = measure(CASES[name], width, seeds)
        report(name, CASES[name], results[name])
        path.write_text(json.dumps(results, indent=1), encoding="utf-8")
    if draws:
        plot(results, FIGURES / f"swarming_{width}.svg")


if __name__ == "__main__":
    main()
