"""Compares ``path``, ``light_tracer``, ``bdpt``, and ``bdpt`` with ``light_paths = auto`` (with its
pilot) at equal samples, by variance and CPU time:

    .venv/bin/python benchmarks/bidirectional.py caustic scenes/corridor.xml /somewhere/scene.xml

Writes one row of Markdown for each scene. Errors are those of ``benchmarks/equal_samples.py``, with
the mean of all images of ``bdpt``; times are the median of the seeds. The efficiency,
1 / (error · time), is relative to ``path``. ``light_tracer`` is judged by the pixels in which it
can see everything: those that show no smooth mirror, smooth glass, mask or null surface. So is
``bdpt`` once more, in the column ``as seen by light_tracer``.

``chosen`` is what the pilot of ``auto`` chose with the last seed, and for how many seeds it did.
``predicted`` is what it expected of that: variance and time in units of those of ``path`` (of the
best choice with light paths, if it chose none). ``measured`` has both from the renders, which
contain the pilot.
"""

from __future__ import annotations

import re

import click
import numpy as np
from equal_samples import (
    TRIMMED,
    Renders,
    camera_rays,
    error,
    load,
    options,
    print_header,
    print_row,
    render_in_turns,
    title,
)

import mitsuba as mi  # isort: skip

INTEGRATORS = {
    "path": {"type": "path"},
    "light_tracer": {"type": "light_tracer"},
    "bdpt": {"type": "bdpt"},
    "auto": {"type": "bdpt", "light_paths": "auto"},
}

COLUMNS = ["scene", "`path`: seconds", "error", "`light_tracer`: time", "error", "efficiency"]
COLUMNS += ["`bdpt`: time", "error", "efficiency", "as seen by `light_tracer`"]
COLUMNS += ["mean of `path`"]
COLUMNS += ["`auto`: time", "error", "efficiency", "chosen", "predicted", "measured"]


def seen(scene: mi.Scene) -> np.ndarray:
    """The pixels in which ``light_tracer`` can see everything, by 16 rays each: [height, width]."""
    width, height = scene.sensors()[0].film().crop_size()
    ray = camera_rays(scene, 16)
    si = scene.ray_intersect(ray)
    flags = si.bsdf(ray).flags()
    hidden = int(mi.BSDFFlags.Delta) | int(mi.BSDFFlags.Null)
    black = si.is_valid() & ((flags & hidden) != 0)
    return ~np.array(black).reshape(height, width, 16).any(axis=2)


@click.command()
@options
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares the integrators on the scenes NAMES."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    for name in names:
        scene = load(name, size)
        renders = render_in_turns(scene, INTEGRATORS, max_depth, spp, seeds)
        print_row([title(name), *cells(renders, seen(scene))])


def cells(renders: dict[str, Renders], visible: np.ndarray) -> list[str]:
    path, mean, everywhere = renders["path"], renders["bdpt"].mean, np.ones_like(visible)

    def ratios(kind: str, pixels: np.ndarray, trimmed: float = TRIMMED) -> tuple[float, float]:
        """Time and error."""
        errors = (error(r.variance, mean, pixels, trimmed) for r in (renders[kind], path))
        return renders[kind].time / path.time, next(errors) / next(errors)

    row = [f"{path.time:.1f}", f"{error(path.variance, mean):.2g}"]
    for kind, pixels in (("light_tracer", visible), ("bdpt", everywhere), ("auto", everywhere)):
        slower, e = ratios(kind, pixels)
        row += [f"{slower:.2f}", f"{e:.2g}", f"{1 / (e * slower):.2g}"]
        if kind == "bdpt":
            row.append(f"{1 / (ratios(kind, visible)[1] * slower):.2g}")
            row.append(f"{path.mean.mean() / mean.mean():.3f}")
    learned = [re.split(r" \(", text) for text in renders["auto"].learned]
    choice, numbers = learned[-1]
    same = sum(other == choice for other, _ in learned)
    predicted = re.findall(r"[\d.]+|inf", numbers)
    slower, e = ratios("auto", everywhere)
    return [*row, f"{choice} ({same} of {len(learned)})", ", ".join(predicted),
            f"{e:.2f}, {slower:.1f}"]  # fmt: skip


if __name__ == "__main__":
    main()
