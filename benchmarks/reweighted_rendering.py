"""Measures patterns and weights of light, lens, time and wavelength samples on scenes.

``benchmarks/reweighted_rendering.py direct`` (or ``lens``, ``time``, ``wavelength``) prints, for
each scene, the error and the time of all patterns and weights, and of the path tracer with
Mitsuba's samplers (five minutes per scene). It plots the gains to ``docs/figures``.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import click
import matplotlib.pyplot as plt
import numpy as np
from equal_samples import load, render_in_turns

from mitsuba_ext.techniques.weighted_points.weighted_sets import WEIGHTS
from mitsuba_ext.util.pointsets import PATTERNS

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "scenes"
FIGURES = ROOT / "docs" / "figures"

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")

#: Scenes for each technique, with the filters of their films.
SCENES: dict[str, dict[str, str]] = {
    "direct": {
        "open": "open:rfilter=gaussian",
        **{n: str(SHARED / n / "scene.xml") for n in ("cornell-box", "kitchen", "living-room")},
    },
    "lens": {"defocus": "defocus:rfilter=gaussian"},
    "time": {"fast_balls": "fast_balls", "fan": "fan"},
    "wavelength": {"prism": "prism", "flint": "flint"},
}

#: Integrators to compare with: only ours render moving shapes and dispersion.
PATH = {"direct": "path", "lens": "path", "time": "composed_path", "wavelength": "composed_path"}

_DIRECT = [("independent", "none"), ("hammersley", "none"), ("hammersley", "unbiased")]

MAX_DEPTH = {"direct": 2, "lens": 6, "time": 4, "wavelength": 12}

SIZE = 160, 90


def render(scene: mi.Scene, integrator: dict[str, Any], spp: int, seeds: range) -> np.ndarray:
    """Images of several seeds."""
    made = mi.load_dict(integrator)
    return np.array([
        mi.render(scene, integrator=made, seed=seed, spp=spp).numpy()[..., :3] for seed in seeds
    ])  # fmt: skip


def errors(images: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """relMSE and MSE, both without the largest 0.1 %."""
    mean = reference.mean(axis=0) if reference.ndim == 4 else reference
    square = (images - reference) ** 2
    relative = square / (mean**2 + 1e-2 * mean.mean() ** 2)
    kept = int(0.999 * square.size)
    return tuple(float(np.sort(x.ravel())[:kept].mean()) for x in (relative, square))


def direct(
    scene: mi.Scene, count: int, seeds: range
) -> dict[tuple[str, str], tuple[float, float]]:
    """The errors of direct light for each pattern and weights. All renders and the reference use
    the same camera rays, so that only the light samples differ."""

    def integrator(pattern: str, weights: str, light_samples: int) -> dict[str, Any]:
        return {"type": "reweighted_direct", "max_depth": 2, "light_samples": light_samples,
                "pattern": pattern, "weights": weights}  # fmt: skip

    exact = render(scene, integrator("sobol", "none", 4096), 4, seeds)
    return {
        (p, w): errors(render(scene, integrator(p, w, count), 4, seeds), exact)
        for p, w in itertools.product(PATTERNS, WEIGHTS)
    }


def reweighted(kind: str, pattern: str, weights: str, count: int) -> dict[str, Any]:
    own = {"type": f"reweighted_{kind}", "pattern": pattern, "weights": weights}
    if kind == "direct":
        return {**own, "max_depth": MAX_DEPTH[kind], "light_samples": count}
    return {**own, "nested": path_of(kind)}


def compare(
    kind: str, scene_name: str, count: int, seeds: int, reference: np.ndarray
) -> dict[str, tuple[float, float, float]]:
    """For each integrator and sampler, relMSE and MSE of the whole image, and the median CPU time
    without compilation."""
    path, is_direct = path_of(kind), kind == "direct"
    spp = 4 * count if is_direct else count
    jobs = {f"path, {name}": (load(scene_name, SIZE, name), path, spp) for name in SAMPLERS}
    scene = jobs["path, independent"][0]
    # A few patterns are enough for the whole image: light samples are a small part of its error
    for pattern, weights in _DIRECT if is_direct else combinations(kind):
        integrator = reweighted(kind, pattern, weights, count)
        jobs[f"{pattern}, {weights}"] = scene, integrator, 4 if is_direct else count
    return {
        label: (*errors(np.array(found.images), reference), found.time)
        for label, found in render_in_turns(jobs, seeds).items()
    }


def path_of(kind: str) -> dict[str, Any]:
    return {"type": PATH[kind], "max_depth": MAX_DEPTH[kind]}


def combinations(kind: str) -> list[tuple[str, str]]:
    """All patterns with all weights that the technique accepts."""
    weights = [w for w in WEIGHTS if not (kind == "wavelength" and w == "unbiased")]
    return list(itertools.product(PATTERNS, weights))


@click.command()
@click.argument("kind", type=click.Choice(list(SCENES)))
@click.argument("names", nargs=-1)
@click.option("--samples", "counts", default=[16, 64, 256], multiple=True, show_default=True)
@click.option("--seeds", default=3, show_default=True)
def main(kind: str, names: tuple[str, ...], counts: tuple[int, ...], seeds: int) -> None:
    """Compares patterns and weights on the scenes NAMES (all, if none is given)."""
    mi.set_variant("llvm_ad_spectral" if kind == "wavelength" else "llvm_ad_rgb")
    scenes = {n: file for n, file in SCENES[kind].items() if not names or n in names}
    gains: dict[str, dict[int, dict[str, float]]] = {}
    for name, file in scenes.items():
        spp = 4096 if kind == "direct" else 16384
        reference = render(load(file, SIZE), path_of(kind), spp, range(7000, 7001))[0]
        for count in counts:
            table = compare(kind, file, count, seeds, reference)
            error_0, mse_0, seconds_0 = table["path, independent"]
            click.echo(
                f"\n{name}, {count} samples: relMSE; relative to path: gain in relMSE and in MSE, "
                f"time, efficiency"
            )
            for label, (error, mse, seconds) in table.items():
                click.echo(
                    f"  {label:28s} {error:9.2e} {error_0 / error:7.2f} {mse_0 / mse:7.2f} "
                    f"{seconds / seconds_0:6.2f} {error_0 * seconds_0 / (error * seconds):7.2f}"
                )
            gains.setdefault(name, {})[count] = {k: mse_0 / row[1] for k, row in table.items()}
            if kind == "direct":
                alone = direct(load(file, SIZE), count, range(seeds))
                plain = alone["independent", "none"]
                click.echo(
                    f"{name}, {count} light samples: gain over independent ones in relMSE and MSE, "
                    f"with the same camera rays"
                )
                for label, found in alone.items():
                    ratios = [p / e for p, e in zip(plain, found)]
                    click.echo(f"  {', '.join(label):28s} {ratios[0]:7.2f} {ratios[1]:7.2f}")
                gains[name][count] = {", ".join(k): plain[0] / e[0] for k, e in alone.items()}
    if len(counts) > 1:
        plot(kind, gains)


def plot(kind: str, gains: dict[str, dict[int, dict[str, float]]]) -> None:
    """A panel for each scene: gain over independent samples against their number."""
    figure, axes = plt.subplots(1, len(gains), figsize=(5 * len(gains), 4.5), squeeze=False)
    for panel, (name, by_count) in zip(axes.flat, gains.items()):
        counts = sorted(by_count)
        for pattern, weights in combinations(kind):
            label = f"{pattern}, {weights}"
            style = dict(zip(WEIGHTS, ("-", "--", ":", "-.")))[weights]
            panel.loglog(counts, [by_count[n][label] for n in counts], style,
                         c=f"C{PATTERNS.index(pattern)}", label=label)  # fmt: skip
        for sampler, marker in zip(SAMPLERS[1:], "os^D"):
            if (label := f"path, {sampler}") in by_count[counts[0]]:
                panel.loglog(counts, [by_count[n][label] for n in counts], c="k", lw=0.7,
                             marker=marker, ms=4, label=label)  # fmt: skip
        panel.set(title=name, xlabel="samples", ylabel="gain")
        panel.set_xticks(counts, [str(n) for n in counts])
        panel.minorticks_off()
        low, high = panel.get_ylim()
        ticks = [t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200) if low < t < high]
        panel.set_yticks(ticks, [f"{t:g}" for t in ticks])
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.tight_layout(rect=(0, 0.28, 1, 1))
    figure.legend(handles, labels, loc="lower center", ncols=8 if len(gains) > 2 else 4, fontsize=7)
    figure.savefig(FIGURES / f"reweighted_{kind}.svg")


if __name__ == "__main__":
    main()
