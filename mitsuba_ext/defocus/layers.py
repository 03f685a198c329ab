"""Layers of a picture, by how much a lens blurs them: what is near hides what is behind it from a
part of the lens only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from .images import Size, filled

#: What is blurred by less, in pixels, is in focus.
IN_FOCUS = 1.0

#: Two layers share what is blurred by up to this much more than the limit between them, relative
#: to the limit and at least in pixels: a surface that crosses the limit has no gap.
_OVERLAP, _LEAST_OVERLAP = 0.25, 1.0

#: Objects that are all nearer than the focus distance, or all farther, get two layers if the more
#: blurred part is blurred by this factor more than the other.
_SPLIT_RATIO = 1.5


@dataclass
class Layer:
    """One layer.

    Attributes:
        color: Four numbers for each pixel: RGB times coverage, and coverage (the share of the
            pixel's area that the layer fills).
        blur: Signed radius of the circle of confusion in pixels (:meth:`ThinLens.blur`). Beyond the
            layer's edges, that of the nearest pixels.
        glow: That of the light of a pixel: its samples weighted by their brightness. ``None`` if
            that is not known.
        shared: What is blurred by more is in the layer before as well.
    """

    color: mi.Float
    blur: mi.Float
    glow: mi.Float | None = None
    shared: float = math.inf


@dataclass
class Limits:
    """Between which blurs the layers are.

    Attributes:
        blurs: Signed radii in pixels, the largest first; one less than layers.
    """

    blurs: list[float]

    @property
    def layer_count(self) -> int:
        return len(self.blurs) + 1

    def contains(self, layer: int, blur: mi.Float) -> mi.Bool:
        """Does the layer of this number hold a surface of this blur? Layers overlap."""
        inside = mi.Bool(True)
        if layer > 0:
            limit = self.blurs[layer - 1]
            inside &= blur <= limit + max(_LEAST_OVERLAP, _OVERLAP * abs(limit))
        if layer < len(self.blurs):
            inside &= blur > self.blurs[layer]
        return inside

    def shared(self, layer: int) -> float:
        """The layer before the one of this number has what is blurred by more as well."""
        return self.blurs[layer - 1] if layer > 0 else math.inf

    def is_before(self, layer: int, blur: mi.Float) -> mi.Bool:
        """Is the layer before a surface of this blur, or does it hold it? Then a ray that got there
        tells whether something of the layer is in its way."""
        inside = mi.Bool(True)
        if layer > 0:
            limit = self.blurs[layer - 1]
            inside &= blur <= limit + max(_LEAST_OVERLAP, _OVERLAP * abs(limit))
        return inside


def limits_of(blurs: np.ndarray) -> Limits:
    """Limits for up to five layers: two before the focus, what is in focus, two behind.

    Parameters:
        blurs: Signed radii of what is seen; any sample of the pixels.
    """
    limits = []
    near, far = blurs[blurs > IN_FOCUS], blurs[blurs < -IN_FOCUS]
    if near.size:
        limits += [*split(near), IN_FOCUS]
    if far.size:
        limits += [-IN_FOCUS, *(-limit for limit in split(-far))]
    return Limits(limits)


def split(blurs: np.ndarray) -> list[float]:
    """The limit between two classes of positive blurs that leaves least variance within these
    (Otsu, *A Threshold Selection Method from Gray-Level Histograms*, 1979); none where the classes
    are alike."""
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
    # In the middle of a gap: all limits in it are as good
    last = best
    while counts[last + 1] == 0:
        last += 1
    return [float(edges[best + 1] + edges[last + 1]) / 2]


@dataclass
class LayerSums:
    """What the samples of each pixel add up to, for one layer.

    Attributes:
        color: RGB of the samples that met the layer.
        blur: Their blurs.
        hits: Their number.
        known: The number of samples that tell whether the layer is there: those that met something
            in it or behind it.
        guides: What guides a denoiser: sums of RGB of the albedo, and of the shading normal; and
            how many of the hits were lights. Empty if there is no denoiser.
        glow: The blurs times the brightness of the samples, and this brightness, if anybody asked.
        shared: What is blurred by more is in the layer before as well.
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
        """Did any sample meet the layer?"""
        return bool((self.hits > 0).numpy().any())


def layers_from_sums(sums: Sequence[LayerSums], size: Size) -> list[Layer]:
    """Layers, the nearest first; those that nothing is in are left out. The last one covers all
    pixels: what nobody has seen gets colours from around."""
    present = [layer.is_there for layer in sums]
    last = max((i for i, is_there in enumerate(present) if is_there), default=0)
    return [
        _layer(layer, size, i == last)
        for i, (layer, is_there) in enumerate(zip(sums, present))
        if is_there or i == last
    ]


def _layer(sums: LayerSums, size: Size, is_last: bool) -> Layer:
    # Filters with negative lobes can leave a pixel with less than no samples
    is_known = (sums.known > 1e-6) & (sums.hits > 1e-6 * sums.known)
    scale = dr.select(is_known, dr.rcp(dr.select(is_known, sums.known, 1)), 0)
    coverage = dr.minimum(sums.hits * scale, 1)
    # Where it overshoots, the colour keeps its brightness
    scale = dr.select(is_known, coverage / dr.select(is_known, sums.hits, 1), 0)
    color = sums.color * scale
    values = dr.ravel(mi.Vector4f(color.x, color.y, color.z, coverage))
    # Nothing hides the last layer from itself
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
    """The sums of a picture of which only the first surface is known.

    Parameters:
        color: Of each pixel, row by row.
        blur: Its signed radius of the circle of confusion.
    """
    sums = []
    for k in range(limits.layer_count):
        hit = dr.select(limits.contains(k, blur), mi.Float(1), 0)
        known = dr.select(limits.is_before(k, blur), mi.Float(1), 0)
        sums.append(LayerSums(color * hit, blur * hit, hit, known, shared=limits.shared(k)))
    return sums
