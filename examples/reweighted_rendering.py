"""Patterns and weights of light samples and of lens samples, on scenes.

``examples/reweighted_rendering.py direct`` and ``… lens`` print, for each scene, the error and the
time of all patterns and weights, and of ``path`` with Mitsuba's samplers (five minutes each); they
plot the former to ``examples/figures``.
"""

from __future__ import annotations

import itertools
import re
import time
from pathlib import Path
from typing import Any

import click
import matplotlib.pyplot as plt
import numpy as np

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)
from mitsuba_ext.decisions.weighted_sets import WEIGHTS
from mitsuba_ext.pointsets import PATTERNS

import mitsuba as mi  # isort: skip

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "scenes"
FIGURES = ROOT / "examples" / "figures"

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")

#: Of each technique; those of the papers are left out where they are missing.
SCENES: dict[str, dict[str, Path]] = {
    "direct": {
        "open": ROOT / "scenes" / "open.xml",
        **{n: SHARED / n / "scene.xml" for n in ("cornell-box", "kitchen", "living-room")},
    },
    "lens": {"defocus": ROOT / "scenes" / "defocus.xml"},
}

WIDTH, HEIGHT = 160, 90


def load(file: Path, sampler: str = "independent") -> mi.Scene:
    """The scene, in a small size, with another sampler."""
    text = re.sub(r'<sampler type="\w+"', f'<sampler type="{sampler}"', file.read_text())
    size = {"resx": WIDTH, "resy": HEIGHT} if SHARED in file.parents else {
        "width": WIDTH, "height": HEIGHT}  # fmt: skip
    resolver = mi.file_resolver()
    resolver.prepend(str(file.parent))
    return mi.load_string(text, **{k: str(v) for k, v in size.items()})


def render(
    scene: mi.Scene, integrator: dict[str, Any], spp: int, seeds: range
) -> tuple[np.ndarray, float]:
    """Images of several seeds, and the median time of one, compilation excluded."""
    made, images, seconds = mi.load_dict(integrator), [], []
    mi.render(scene, integrator=made, seed=10**6, spp=spp).numpy()
    for seed in seeds:
        begin = time.perf_counter()
        images.append(mi.render(scene, integrator=made, seed=seed, spp=spp).numpy()[..., :3])
        seconds.append(time.perf_counter() - begin)
    return np.array(images), float(np.median(seconds))


def errors(images: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """relMSE and MSE, both without the largest 0.1 %."""
    mean = reference.mean(axis=0) if reference.ndim == 4 else reference
    square = (images - reference) ** 2
    relative = square / (mean**2 + 1e-2 * mean.mean() ** 2)
    kept = int(0.999 * square.size)
    return tuple(float(np.sort(x.ravel())[:kept].mean()) for x in (relative, square))


def direct(scene: mi.Scene, count: int, seeds: range) -> dict[tuple[str, str], float]:
    """Pattern, weights → error of direct light. All see the same camera rays, so that nothing but
    the light samples differs from the reference."""

    def integrator(pattern: str, weights: str, light_samples: int) -> dict[str, Any]:
        return {"type": "reweighted_direct", "max_depth": 2, "light_samples": light_samples,
                "pattern": pattern, "weights": weights}  # fmt: skip

    exact, _ = render(scene, integrator("sobol", "none", 4096), 4, seeds)
    return {
        (p, w): errors(render(scene, integrator(p, w, count), 4, seeds)[0], exact)[0]
        for p, w in itertools.product(PATTERNS, WEIGHTS)
    }


def compare(
    kind: str, file: Path, count: int, seeds: range
) -> dict[str, tuple[float, float, float]]:
    """What is rendered with → relMSE and MSE of the whole image, and seconds."""
    depth = 2 if kind == "direct" else 6
    path = {"type": "path", "max_depth": depth}
    spp = 4 * count if kind == "direct" else count
    scene = load(file)
    reference = render(scene, path, 4096 if kind == "direct" else 16384, range(7000, 7001))[0][0]
    result = {}
    for sampler in SAMPLERS:
        images, seconds = render(load(file, sampler), path, spp, seeds)
        result[f"path, {sampler}"] = *errors(images, reference), seconds
    for pattern, weights in itertools.product(PATTERNS, WEIGHTS):
        if kind == "direct":
            integrator = {"type": "reweighted_direct", "max_depth": depth, "light_samples": count,
                          "pattern": pattern, "weights": weights}  # fmt: skip
            images, seconds = render(scene, integrator, 4, seeds)
        else:
            integrator = {"type": "reweighted_lens", "pattern": pattern, "weights": weights,
                          "nested": path}  # fmt: skip
            images, seconds = render(scene, integrator, spp, seeds)
        result[f"{pattern}, {weights}"] = *errors(images, reference), seconds
    return result


@click.command()
@click.argument("kind", type=click.Choice(["direct", "lens"]))
@click.argument("names", nargs=-1)
@click.option("--samples", "counts", default=[16, 64, 256], multiple=True, show_default=True)
@click.option("--seeds", default=3, show_default=True)
def main(kind: str, names: tuple[str, ...], counts: tuple[int, ...], seeds: int) -> None:
    """Compares patterns and weights on the scenes NAMES (all that there are, if none is given)."""
    mi.set_variant("llvm_ad_rgb")
    scenes = {n: f for n, f in SCENES[kind].items() if f.exists() and (not names or n in names)}
    gains: dict[str, dict[int, dict[str, float]]] = {}
    for name, file in scenes.items():
        for count in counts:
            table = compare(kind, file, count, range(seeds))
            error_0, mse_0, seconds_0 = table["path, independent"]
            click.echo(
                f"\n{name}, {count} samples: relMSE; gain beside path in relMSE and MSE, time, "
                f"efficiency"
            )
            for label, (error, mse, seconds) in table.items():
                click.echo(
                    f"  {label:28s} {error:9.2e} {error_0 / error:7.2f} {mse_0 / mse:7.2f} "
                    f"{seconds / seconds_0:6.2f} {error_0 * seconds_0 / (error * seconds):7.2f}"
                )
            gains.setdefault(name, {})[count] = {k: mse_0 / row[1] for k, row in table.items()}
            if kind == "direct":
                alone = direct(load(file), count, range(seeds))
                plain = alone["independent", "none"]
                click.echo(f"{name}, {count} light samples: gain over independent ones, alone")
                for label, error in alone.items():
                    click.echo(f"  {', '.join(label):28s} {plain / error:7.2f}")
                gains[name][count] = {", ".join(k): plain / e for k, e in alone.items()}
    if len(counts) > 1:
        plot(kind, gains)


def plot(kind: str, gains: dict[str, dict[int, dict[str, float]]]) -> None:
    """A panel for each scene: gain over independent samples against their number."""
    figure, axes = plt.subplots(1, len(gains), figsize=(5 * len(gains), 4.5), squeeze=False)
    for panel, (name, by_count) in zip(axes.flat, gains.items()):
        counts = sorted(by_count)
        for i, pattern in enumerate(PATTERNS):
            for weights, style in zip(WEIGHTS, ("-", "--", ":", "-.")):
                label = f"{pattern}, {weights}"
                panel.loglog(counts, [by_count[n][label] for n in counts], style, c=f"C{i}",
                             label=label)  # fmt: skip
        panel.set(title=name, xlabel="samples", ylabel="gain")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.tight_layout(rect=(0, 0.25, 1, 1))
    figure.legend(handles, labels, loc="lower center", ncols=8 if len(gains) > 2 else 4, fontsize=7)
    figure.savefig(FIGURES / f"reweighted_{kind}.svg")


if __name__ == "__main__":
    main()
