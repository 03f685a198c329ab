"""How long the filters of depth of field take:

    .venv/bin/python benchmarks/defocus_time.py --size 1920 1080

The picture has bars near the lens (a third of it), a disk in focus, and chequers far behind; the
circle of confusion of what is near or far has a radius of 2 % of the width. Writes a row of
Markdown for each filter: seconds of wall clock and of CPU time, the smallest of three.
"""

from __future__ import annotations

import math
import time

import click
import defocus_rivals  # noqa: F401  (adds its filters)
import numpy as np
from equal_samples import print_header, print_row

from mitsuba_ext.estimators.defocus.filters import FILTERS, defocus
from mitsuba_ext.estimators.defocus.thin_lens import ThinLens

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip


def picture(width: int, height: int) -> tuple[mi.TensorXf, mi.TensorXf]:
    """Colour and depth."""
    y, x = np.mgrid[:height, :width] / width
    chequers = ((x * 60).astype(int) + (y * 60).astype(int)) % 2
    is_near = (x * 6) % 1 < 1 / 3
    in_focus = (x - 0.5) ** 2 + (y - 0.3) ** 2 < 0.15**2
    color = np.stack([chequers, chequers, 0.5 * chequers], axis=2)
    color[in_focus], color[is_near] = 0.4, 0.1
    depth = np.where(is_near, 1.0, np.where(in_focus, 2.0, np.inf))
    return mi.TensorXf(color.astype(np.float32)), mi.TensorXf(depth.astype(np.float32))


@click.command()
@click.option("--size", type=(int, int), default=(1920, 1080))
def main(size: tuple[int, int]) -> None:
    mi.set_variant("llvm_ad_rgb")
    color, depth = picture(*size)
    # At depth 1 and at infinity, the radius is half of the aperture's at depth 1
    radius = 0.04 * 2 * math.tan(math.radians(45) / 2)
    lens = ThinLens(radius, 2.0, 45.0, size[0])
    print_header(["filter", "seconds", "CPU seconds"])
    for name in FILTERS:
        times = []
        for _ in range(4):
            begin = time.perf_counter(), time.process_time()
            dr.eval(defocus(color, depth, lens, name))
            dr.sync_thread()
            times.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
        # The first one compiles kernels
        print_row([name, *(f"{seconds:.2f}" for seconds in np.min(times[1:], axis=0))])


if __name__ == "__main__":
    main()
