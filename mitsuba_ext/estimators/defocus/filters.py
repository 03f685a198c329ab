"""The filters of this folder, by name, with a common interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from .effective import effective_filter, effective_limits
from .images import Size
from .layers import LayerSums, Limits, layers_from_sums, limits_of, sums_of_picture
from .lens_filter import lens_filter
from .thin_lens import ThinLens


@dataclass
class Capture:
    """The image seen from the centre of the lens, in layers.

    Attributes:
        size: The size of the image.
        sums: The sums of each layer.
        blur: The signed radius of the circle of confusion of the first surface, in pixels.
    """

    size: Size
    sums: list[LayerSums]
    blur: mi.Float


class Filter(Protocol):
    """Makes the image through a lens from the image seen from its centre.

    Attributes:
        has_layers: Whether it uses surfaces behind the first one.
    """

    has_layers: bool

    def limits(self, blurs: np.ndarray) -> Limits:
        """The limits of the layers, for surfaces with these blurs."""

    def picture(self, capture: Capture) -> mi.Color3f:
        """The image through the lens. Called after :meth:`limits`."""


class _Lens:
    has_layers = True

    def limits(self, blurs: np.ndarray) -> Limits:
        return limits_of(blurs)

    def picture(self, capture: Capture) -> mi.Color3f:
        return lens_filter(layers_from_sums(capture.sums, capture.size), capture.size)


class _Effective:
    has_layers = True
    _cap = 0.0

    def limits(self, blurs: np.ndarray) -> Limits:
        limits, self._cap = effective_limits(blurs)
        return limits

    def picture(self, capture: Capture) -> mi.Color3f:
        layers = layers_from_sums(capture.sums, capture.size)
        has_near = self._cap > 0 and capture.sums[0].is_there
        near = layers.pop(0) if has_near else None
        return effective_filter(near, layers, capture.size, self._cap)


#: The filters by name. A benchmark adds others for comparison.
FILTERS: dict[str, Callable[[], Filter]] = {"lens": _Lens, "effective": _Effective}


def defocus(
    color: mi.TensorXf, depth: mi.TensorXf, lens: ThinLens, filter: str = "lens"
) -> mi.TensorXf:
    """The image through a lens, from the image seen from its centre.

    Surfaces hidden behind near objects are filled in from visible surfaces around them.

    Parameters:
        color: RGB in any range, [y, x, 3].
        depth: Depth along the axis of the lens, positive, [y, x]; infinite for the sky.
        lens: The lens. Its ``film_width`` is the width of the image, or larger if the image is a
            crop.
        filter: One of ``FILTERS``.

    Raises:
        ValueError: The shapes do not match, or the filter is unknown.
    """
    height, width, *rest = color.shape
    if rest != [3] or tuple(depth.shape) != (height, width):
        raise ValueError(
            f"color has the shape {tuple(color.shape)} and depth {tuple(depth.shape)}: give "
            f"(height, width, 3) and (height, width)"
        )
    if filter not in FILTERS:
        raise ValueError(f'there is no filter "{filter}"; there are {", ".join(FILTERS)}')
    size, found = Size(width, height), FILTERS[filter]()
    lane = dr.arange(mi.UInt32, size.count)
    seen = mi.Color3f(*(dr.gather(mi.Float, color.array, 3 * lane + k) for k in range(3)))
    blur = lens.blur(dr.gather(mi.Float, depth.array, lane))
    dr.eval(seen, blur)
    limits = found.limits(blur.numpy())
    capture = Capture(size, sums_of_picture(seen, blur, limits), blur)
    picture = found.picture(capture)
    return mi.TensorXf(dr.ravel(picture), shape=(height, width, 3))
