"""Speed against error of our integrators and ``path``, on our scenes and on those of the papers.

``make bench`` runs all of it (more than an hour on two cores), writes one report, and puts its
figures into docs/results/benchmark.md; ``benchmarks/benchmark.py open kitchen`` runs some scenes,
and does not change that page. Runs that ``out/benchmark`` holds are not rendered again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from mitsuba_ext import compare

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "scenes"

#: ``path``, the strongest choice of lights that learns nothing, learned lights, path guiding, and
#: both of these where they pay.
INTEGRATORS = {
    "path": "path",
    "spatial": "composed_path:next_event=spatial",
    "neepp": "neepp",
    "pss_guided": "pss_guided",
    "auto_path": "auto_path",
}

#: Our scenes, at their own size.
OURS = ("door_ajar", "rooms", "window", "open", "cornell_box", "mirrors_and_glass", "sunny_gloss")

#: Scenes of the papers, with the size of their stored reference.
THEIRS = {
    "veach-ajar": (320, 180),
    "kitchen": (320, 180),
    "staircase": (180, 320),
    "bathroom": (180, 180),
    "staircase2": (180, 180),
    "dining-room": (320, 180),
    "classroom": (320, 180),
    "living-room": (320, 180),
}

#: Maximum depth of the stored references, and of all integrators.
DEPTH = {"max_depth": 6}

PAGE = ROOT / "docs" / "results" / "benchmark.md"
FIGURE = ROOT / "docs" / "figures" / "efficiency.svg"


def _with_interval(value: float, low: float | None, high: float | None, **_: Any) -> str:
    """The interval is unknown if two integrators have no times of a common session."""
    return f"{value:.2f}" if low is None else f"{value:.2f} [{low:.2f}, {high:.2f}]"


@click.command()
@click.argument("names", nargs=-1)
@click.option("--spp", default=128, show_default=True, help="Samples per pixel of each run.")
@click.option("--seeds", default=3, show_default=True, help="Runs of each integrator.")
@click.option("--reference-spp", default=1024, show_default=True, help="Of our scenes.")
@click.option("--integrator", "integrators", multiple=True, help="Instead of the standard ones.")
@click.option("--out", type=click.Path(path_type=Path), default=ROOT / "out" / "benchmark")
def main(
    names: tuple[str, ...],
    spp: int,
    seeds: int,
    reference_spp: int,
    integrators: tuple[str, ...],
    out: Path,
) -> None:
    """Compares the integrators on the scenes NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    available = [*OURS, *(THEIRS if SHARED.is_dir() else ())]
    unknown = set(names) - set(available)
    if unknown:
        raise click.UsageError(f"no scene {', '.join(sorted(unknown))}: {', '.join(available)}")
    comparison = compare.Comparison(
        [_setup(name) for name in names or available],
        integrators or INTEGRATORS,
        compare.equal_samples(spp),
        seeds=seeds,
        folder=out,
        reference_spp=reference_spp,
        command="benchmarks/benchmark.py",
    )
    results = comparison.run()
    compare.show(results)
    print(out / "report.html")
    if not names and not integrators:
        _write_table(results)
        _write_figure(results)


def _setup(name: str) -> compare.SceneSetup:
    if name in OURS:
        return compare.SceneSetup(ROOT / "scenes" / f"{name}.xml", parameters=DEPTH)
    width, height = THEIRS[name]
    return compare.SceneSetup(
        SHARED / name / "scene.xml",
        (width, height),
        DEPTH,
        SHARED / name / f"reference_path_depth6_{width}x{height}.exr",
    )


def _write_table(results: dict[str, Any]) -> None:
    """Replaces the table between the marks in the page."""
    text = PAGE.read_text(encoding="utf-8")
    marks = "<!-- benchmark: begin -->", "<!-- benchmark: end -->"
    pattern = f"(?<={marks[0]}\n).*(?={marks[1]})"
    table = "\n".join(_table(results)) + "\n"
    PAGE.write_text(re.sub(pattern, lambda _: table, text, flags=re.DOTALL), encoding="utf-8")


def _table(results: dict[str, Any]) -> Iterator[str]:
    columns = ["scene", "`path`"]
    for label in list(INTEGRATORS)[1:]:
        columns += [f"{label}: time", "error", "efficiency"]
    yield "| " + " | ".join(columns) + " |"
    yield "|" + "---|" * len(columns)
    for scene in results["scenes"]:
        first, *others = (record["levels"][-1] for record in scene["integrators"])
        cells = [scene["name"], f"{first['figures']['seconds']['value']:.1f} s"]
        for ratios in (level["ratios"] for level in others):
            cells += [
                f"{ratios['seconds']['value']:.2f}",
                f"{ratios['relmse_trimmed']['value']:.2f}",
                _with_interval(**ratios["efficiency"]),
            ]
        yield "| " + " | ".join(cells) + " |"


def _write_figure(results: dict[str, Any]) -> None:
    """Efficiency relative to ``path`` with its intervals, a row per scene."""
    from matplotlib import rc_context, ticker
    from matplotlib.figure import Figure

    scenes = results["scenes"]
    figure = Figure(figsize=(7, 0.7 + 0.5 * len(scenes)), layout="constrained")
    axes = figure.subplots()
    for number, label in enumerate(list(INTEGRATORS)[1:]):
        ratios = [scene["integrators"][number + 1]["levels"][-1]["ratios"]["efficiency"]
                  for scene in scenes]
        values = [ratio["value"] for ratio in ratios]
        errors = [[ratio["value"] - ratio["low"] for ratio in ratios],
                  [ratio["high"] - ratio["value"] for ratio in ratios]]
        rows = [row + 0.2 * (number - 1.5) for row in range(len(scenes))]
        axes.errorbar(values, rows, xerr=errors, fmt="osD^"[number], capsize=3, label=label)
    axes.axvline(1, color="gray", linewidth=0.8)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(ticker.NullLocator())
    axes.set_yticks(range(len(scenes)), [scene["name"] for scene in scenes])
    axes.invert_yaxis()
    axes.set_xlabel("efficiency relative to path (95 % interval)")
    axes.legend()
    FIGURE.parent.mkdir(exist_ok=True)
    with rc_context({"svg.hashsalt": "efficiency"}):  # the same file from the same figures
        figure.savefig(FIGURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
