"""How filters of depth of field show bars behind the edge of something near:

    .venv/bin/python benchmarks/defocus_edges.py

A half plane, blurred by a circle of 16 pixels, stands before bars that are blurred by as much on
the other side of the focus. Where the lens sees the bars from x < t only (x from -1 to 1), their
image is shifted and has more contrast. Writes a row for each t: the shift in pixels, and the
contrast (1 for sharp bars), by geometry, by the filter of lens points, and by the source's
effective circle of confusion.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from equal_samples import print_header, print_row

from mitsuba_ext.estimators.defocus.effective import effective_filter
from mitsuba_ext.estimators.defocus.images import Size
from mitsuba_ext.estimators.defocus.layers import LayerSums, layers_from_sums
from mitsuba_ext.estimators.defocus.lens_filter import lens_filter

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

RADIUS, PERIOD, SIZE = 16.0, 48.0, (129, 33)
COLUMNS = ["t", "shift: geometry", "lens", "effective", "contrast: geometry", "lens", "effective"]


def layer(coverage: np.ndarray, color: np.ndarray, blur: float, size: Size) -> LayerSums:
    hits = mi.Float(coverage.ravel().astype(np.float32))
    color = mi.Color3f(mi.Float((coverage * color).ravel().astype(np.float32)))
    return LayerSums(color, blur * hits, hits, dr.full(mi.Float, 1, size.count))


def response(name: str, t: float) -> complex:
    """What a filter makes of a complex wave, by the brightness of what is left of white."""
    size = Size(*SIZE)
    x, ones = np.arange(SIZE[0]), np.ones(SIZE[::-1])
    middle = SIZE[0] // 2
    near = ones * np.clip(x + 1 - (middle + 0.5 + t * RADIUS), 0, 1)
    found = []
    for wave in (np.cos, np.sin, np.zeros_like):
        far = ones * (1 + wave(2 * np.pi * (x - middle) / PERIOD))
        sums = [layer(near, 0 * ones, RADIUS, size), layer(ones, far, -RADIUS, size)]
        layers = layers_from_sums(sums, size)
        if name == "lens":
            picture = lens_filter(layers, size)
        else:
            picture = effective_filter(layers[0], layers[1:], size, RADIUS)
        # Four rows: neighbouring pixels turn the points of the lens by different angles
        found.append(picture.x.numpy().reshape(SIZE[::-1])[16:20, middle].mean())
    cos, sin, white = found
    return complex(cos / white - 1, sin / white - 1)


def geometry(t: float) -> complex:
    """The mean of the wave over the part of the lens with x < t."""
    x = np.linspace(-1, t, 20001)
    weight = np.sqrt(1 - x**2)
    return complex((weight * np.exp(-2j * np.pi * RADIUS * x / PERIOD)).sum() / weight.sum())


def main() -> None:
    mi.set_variant("llvm_ad_rgb")
    print_header(COLUMNS)
    for t in (-0.5, -0.2, 0.0, 0.3, 0.7):
        waves = [geometry(t), response("lens", t), response("effective", t)]
        shifts = [cmath.phase(wave) * PERIOD / (2 * math.pi) for wave in waves]
        print_row([f"{t:g}", *(f"{s:.2f}" for s in shifts), *(f"{abs(w):.3f}" for w in waves)])


if __name__ == "__main__":
    main()
