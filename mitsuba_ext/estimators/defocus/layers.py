"""Divides an image into layers by their blur through a lens. Layers are needed because near objects
hide the objects behind them from only a part of the lens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .images import Size, filled

#: The maximum blur of surfaces in focus, in pixels.
IN_FOCUS = 1.0

#: The overlap of two layers at their limit, relative to the limit, and its minimum in pixels. Both
#: layers contain the surfaces in the overlap, so that a surface that crosses the limit has no gap.
_OVERLAP, _MIN_OVERLAP = 0.25, 1.0

#: The minimum ratio between the blurs of two parts of the surfaces on one side of the focus for
#: dividing them into two layers.
_SPLIT_RATIO = 1.5


@dataclass
class Layer:
    """One layer.

    Attributes:
        color: Four numbers for each pixel: RGB times coverage, and coverage (the fraction of the
            pixel's area that the layer fills).
        blur: Signed radius of the circle of confusion in pixels (:meth:`ThinLens.blur`). Beyond the
            layer's edges, the radius at the nearest pixels.
        glow: The same radius as a mean of samples weighted by their brightness; ``None`` if
            unknown.
        shared: Surfaces with a larger blur are in the layer before as well.
    """

    color: mi.Float
    blur: mi.Float
    glow: mi.Float | None = None
    shared: float = math.inf


@dataclass
class Limits:
    """The limits between layers.

    Attributes:
        blurs: Signed radii in pixels, largest first; one fewer than there are layers.
    """

    blurs: list[float]

    @property
    def layer_count(self) -> int:
        return len(self.blurs) + 1

    def contains(self, layer: int, blur: mi.Float) -> mi.Bool:
        """Whether the layer with this index contains a surface with this blur. Layers overlap."""
        inside = mi.Bool(True)
        if layer > 0:
            limit = self.blurs[layer - 1]
            inside &= blur <= limit + max(_MIN_OVERLAP, _OVERLAP * abs(limit))
        if layer < len(self.blurs):
            inside &= blur > self.blurs[layer]
        return inside

    def shared(self, layer: int) -> float:
        """The value of :attr:`Layer.shared` for the layer with this index."""
        return self.blurs[layer - 1] if layer > 0 else math.inf

    def is_before(self, layer: int, blur: mi.Float) -> mi.Bool:
        """Whether the layer is in front of a surface with this blur or contains it. If so, a ray
        that reaches the surface shows whether the layer covers it."""
        inside = mi.Bool(True)
        if layer > 0:
            limit = self.blurs[layer - 1]
            inside &= blur <= limit + max(_MIN_OVERLAP, _OVERLAP * abs(limit))
        return inside


def limits_of(blurs: np.ndarray) -> Limits:
    """Limits for up to five layers: two in front of the focus, one in focus, two behind.

    Parameters:
        blurs: Signed radii of the visible surfaces; any sample of the pixels.
    """
    limits = []
    near, far = blurs[blurs > IN_FOCUS], blurs[blurs < -IN_FOCUS]
    if near.size:
        limits += [*split(near), IN_FOCUS]
    if far.size:
        limits += [-IN_FOCUS, *(-limit for limit in split(-far))]
    return Limits(limits)


def split(blurs: np.ndarray) -> list[float]:
    """The limit that divides positive blurs into two classes with the smallest variance within them
    (Otsu, *A Threshold Selection Method from Gray-Level Histograms*, 1979); none for similar
    classes."""
    if blurs.max() < _SPLIT_RATIO * blurs.min():
        return []
    counts, edges = np.histogram(blurs.astype(np.float64), 256)
    middles = (edges[1:] + edges[:-1]) / 2
    below, total = np.cumsum(counts), counts.sum()
    sums = np.cumsum(counts * middles)
    above = total - below
    mean_below = sums / np.maximum(below, 1)
    mean_above = (sums[-1] - sums) / np.maximum(above, 1)
    between = below * above * (mean_above - mean_below) ** 2
    best = int(between.argmax())
    if between[best] <= 0 or mean_above[best] < _SPLIT_RATIO * mean_below[best]:
        return []
    # Take the middle of a gap in the histogram, because all limits within the gap are equally good
    last = best
    while counts[last + 1] == 0:
        last += 1
    return [float(edges[best + 1] + edges[last + 1]) / 2]


@dataclass
class LayerSums:
    """Sums over each pixel's samples, for one layer.

    Attributes:
        color: The RGB of the samples that hit the layer.
        blur: The blurs of these samples.
        hits: The number of these samples.
        known: The number of samples that hit a surface in the layer or behind it, and so show
            whether the layer is there.
        guides: For a denoiser: sums of the albedo's RGB and of the shading normal, and the number
            of hits on lights. Empty if there is no denoiser.
        glow: The sums of the blurs times the brightness of the samples, and of this brightness;
            ``None`` if not needed.
        shared: Surfaces with a larger blur are in the layer before as well.
    """

    color: mi.Color3f
    blur: mi.Float
    hits: mi.Float
    known: mi.Float
    guides: list[mi.Float] = field(default_factory=list)
    glow: tuple[mi.Float, mi.Float] | None = None
    shared: float = math.inf

    @property
    def is_there(self) -> bool:
        """Whether any sample hit the layer."""
        return bool((self.hits > 0).numpy().any())


def layers_from_sums(sums: Sequence[LayerSums], size: Size) -> list[Layer]:
    """Layers, nearest first, without empty ones. The last layer covers all pixels: where no sample
    has hit it, it is filled with surrounding colours."""
    present = [layer.is_there for layer in sums]
    last = max((i for i, is_there in enumerate(present) if is_there), default=0)
    return [
        _layer(layer, size, i == last)
        for i, (layer, is_there) in enumerate(zip(sums, present))
        if is_there or i == last
    ]


def _layer(sums: LayerSums, size: Size, is_last: bool) -> Layer:
    # With film filters with negative lobes, the sums of a pixel can be negative
    is_known = (sums.known > 1e-6) & (sums.hits > 1e-6 * sums.known)
    scale = dr.select(is_known, dr.rcp(dr.select(is_known, sums.known, 1)), 0)
    coverage = dr.minimum(sums.hits * scale, 1)
    # The mean colour of the hits, times the clipped coverage
    scale = dr.select(is_known, coverage / dr.select(is_known, sums.hits, 1), 0)
    color = sums.color * scale
    values = dr.ravel(mi.Vector4f(color.x, color.y, color.z, coverage))
    # The last layer is filled up to full coverage because nothing is behind it
    weight = coverage if is_last else dr.select(sums.known > 1e-6, mi.Float(1), 0)
    blurs = sums.blur * scale
    dr.eval(values, weight, blurs, coverage)
    blur = filled(mi.Float, blurs, coverage, size)
    glow = None
    if sums.glow is not None:
        product, bright = sums.glow
        is_bright = bright > 1e-6
        glow = dr.select(is_bright, product / dr.select(is_bright, bright, 1), blur)
    return Layer(filled(mi.Vector4f, values, weight, size), blur, glow, sums.shared)


def sums_of_picture(color: mi.Color3f, blur: mi.Float, limits: Limits) -> list[LayerSums]:
    """The sums of an image for which only the first surfaces are known.

    Parameters:
        color: The colour of each pixel, row by row.
        blur: The signed radius of its circle of confusion.
        limits: The limits of the layers.
    """
    sums = []
    for k in range(limits.layer_count):
        hit = dr.select(limits.contains(k, blur), mi.Float(1), 0)
        known = dr.select(limits.is_before(k, blur), mi.Float(1), 0)
        sums.append(LayerSums(color * hit, blur * hit, hit, known, shared=limits.shared(k)))
    return sums
