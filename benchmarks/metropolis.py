"""Compares ``path``, ``bdpt`` and Metropolis integrators at equal numbers of samples and mutations,
by variance and CPU time, start-up included:

    .venv/bin/python benchmarks/metropolis.py caustic ring /somewhere/scene.xml --size 192 108
    .venv/bin/python benchmarks/metropolis.py fast_balls fan --motion --max-depth 4
    .venv/bin/python benchmarks/metropolis.py ring keyhole --paths
    .venv/bin/python benchmarks/metropolis.py caustic --paths --region 0.2 0.5 0.8 0.9

Writes one row of Markdown for each scene. Errors are those of ``benchmarks/equal_samples.py``,
relative to the mean of all images of ``pssmlt``; times are the median of the seeds. The efficiency,
1 / (error · time), is relative to ``path``. ``means`` has those of ``path`` and ``bdpt``, relative
to that of ``pssmlt``: where they are below 1, light is found too rarely for the variance to tell
the error. With ``--motion`` or ``--paths``, there is a row for each integrator: those that render
moving shapes, or chains of paths and others; ``--region`` counts the errors of a part of the image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from equal_samples import (
    Renders,
    error,
    load,
    options,
    percentile,
    print_header,
    print_row,
    render_in_turns,
    title,
)

import click  # isort: skip
import mitsuba as mi  # isort: skip

INTEGRATORS = {
    "path": {"type": "path"},
    "bdpt": {"type": "bdpt"},
    "pssmlt": {"type": "pssmlt"},
    "pssmlt, path": {"type": "pssmlt", "bidirectional": False},
    "erpt": {"type": "erpt", "bidirectional": True},
    "erpt, path": {"type": "erpt"},
}

_PATH = {"type": "composed_path"}
_PSSMLT = {"type": "pssmlt", "bidirectional": False}

#: Mitsuba's path tracer does not see moving shapes.
MOTION = {
    "path": _PATH,
    "path, multijitter": {**_PATH, "sampler": "multijitter"},
    "reweighted_time": {"type": "reweighted_time", "nested": _PATH},
    "pssmlt": _PSSMLT,
    "pssmlt, only chains": {**_PSSMLT, "direct_samples": -1},
    "pssmlt, only chains, two_stage": {**_PSSMLT, "direct_samples": -1, "two_stage": True},
    "erpt": {"type": "erpt"},
    "erpt, only chains": {"type": "erpt", "direct_samples": -1},
}

#: Chains of paths, and what they are compared with.
PATHS = {
    "path": {"type": "path"},
    "bdpt": {"type": "bdpt"},
    "pssmlt": {"type": "pssmlt"},
    "erpt": {"type": "erpt"},
    "erpt, paths": {"type": "erpt", "mutations": "path"},
    "erpt, paths, outliers": {"type": "erpt", "mutations": "path", "outliers": 10.0},
    "mlt": {"type": "mlt"},
}

COLUMNS = ["scene", "`path`: seconds", "error", "means"]
for _kind in list(INTEGRATORS)[1:]:
    COLUMNS += [f"{_kind}: time", "error", "efficiency"]
COLUMNS.append("accepted")


@click.command()
@options
@click.option("--motion", is_flag=True, help="Compare integrators that render moving shapes.")
@click.option("--paths", is_flag=True, help="Compare chains of paths with others.")
@click.option("--region", type=(float,) * 4, default=(0, 0, 1, 1),
              help="Left, top, right, bottom of what counts, in units of the film's size.")
def main(
    names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple, motion: bool,
    paths: bool, region: tuple,
) -> None:
    """Compares the integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    if motion or paths:
        print_header(["scene", "", "time", "error", "efficiency", "99th percentile", "mean"])
        for name in names:
            if motion:
                print_motion(name, size, max_depth, spp, seeds)
            else:
                renders = render_in_turns(load(name, size), PATHS, max_depth, spp, seeds)
                print_each(title(name), part(renders, region), "mlt")
        return
    print_header(COLUMNS)
    for name in names:
        renders = render_in_turns(load(name, size), INTEGRATORS, max_depth, spp, seeds)
        print_row([title(name), *cells(renders)])


def part(renders: dict[str, Renders], region: tuple) -> dict[str, Renders]:
    """The same with a region of the images: its left, top, right and bottom, from 0 to 1."""

    def cut(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        left, top, right, bottom = np.rint(np.multiply(region, [width, height] * 2)).astype(int)
        return image[top:bottom, left:right]

    return {k: replace(r, images=[cut(image) for image in r.images]) for k, r in renders.items()}


def cells(renders: dict[str, Renders]) -> list[str]:
    path, mean = renders["path"], renders["pssmlt"].mean
    base = error(path.variance, mean)
    means = [renders[kind].mean.mean() / mean.mean() for kind in ("path", "bdpt")]
    row = [f"{path.time:.1f}", f"{base:.2g}", ", ".join(f"{m:.3f}" for m in means)]
    for kind in list(INTEGRATORS)[1:]:
        slower = renders[kind].time / path.time
        e = error(renders[kind].variance, mean) / base
        row += [f"{slower:.2f}", f"{e:.2g}", f"{1 / (e * slower):.2g}"]
    return [*row, renders["pssmlt"].learned[-1].removeprefix("accepted: ")]


def print_motion(name: str, size: tuple, max_depth: int, spp: int, seeds: int) -> None:
    """A row for each integrator of :data:`MOTION`, in units of the first."""
    renders = {}
    for kind, values in MOTION.items():
        values = dict(values)
        scene = load(name, size, values.pop("sampler", ""))
        if "nested" in values:
            values["nested"] = {**values["nested"], "max_depth": max_depth}
        else:
            values["max_depth"] = max_depth
        renders |= render_in_turns(scene, {kind: values}, None, spp, seeds)
    print_each(title(name), renders, "path, multijitter")


def print_each(name: str, renders: dict[str, Renders], best: str) -> None:
    """A row for each integrator, in units of ``path``. Errors are relative to the mean of one."""
    base, mean = renders["path"], renders[best].mean
    first = [error(base.variance, mean), percentile(base.variance, mean)]
    for kind, r in renders.items():
        slower = r.time / base.time
        e, p = (f(r.variance, mean) / x for f, x in zip((error, percentile), first))
        print_row([
            name, kind, f"{slower:.2f}", f"{e:.2g}", f"{1 / (e * slower):.2g}", f"{p:.2g}",
            f"{r.mean.mean() / mean.mean():.3f}",
        ])  # fmt: skip


if __name__ == "__main__":
    main()
