"""The effective circle of confusion: an approximate image of three layers through a lens."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .images import Pyramid, Size, rgb
from .layers import IN_FOCUS, Layer, Limits, split
from .lens_points import LensPoints, disk_mean, ring_points
from .near_field import near_field


def effective_filter(
    near: Layer | None, rest: list[Layer], size: Size, cap: float
) -> mi.Color3f:
    """The image of a near, an in-focus and a far layer through a thin lens.

    The near layer is blurred by a separable filter of one radius, ``cap``. Its opacity α is the
    fraction of the lens that it hides from the layers behind it. A pixel of these layers is the
    mean over its effective circle of confusion, at 48 points: the circle of its own blur, scaled by
    1 - α, with its centre moved towards the near objects.

    A straight edge that hides the fraction α of the lens's width leaves a part whose centre lies at
    a distance α from the centre of the lens. The circle is therefore moved by α times the full
    radius. The source moves it by α times the effective radius, which is α (1 - α) times the full
    radius: the two agree only for small α. Surfaces nearer than the focus are seen on the other
    side of the lens, so their circle is moved away from the near objects.

    Source: J. J. Guo, PhD thesis, TU Delft, chapter 5, Eqs. 5.4 and 5.5.

    Parameters:
        near: The near layer; ``None`` if there is none.
        rest: The other layers, nearest first.
        size: The size of the images.
        cap: The radius of the near layer's blur, in pixels.
    """
    lens = LensPoints(ring_points())
    index, position = size.pixels()
    through, color = mi.Float(1), mi.Color3f(0)
    hidden, direction = mi.Float(0), mi.Vector2f(0)
    if near is not None:
        field = near_field(near, size, cap)
        hidden, direction = field.color.w, field.direction
        color, through = rgb(field.color), 1 - hidden
    for layer in rest:
        radius = dr.gather(mi.Float, layer.blur, index)
        # The shift changes sign with the radius: behind the focus, it is mirrored. Eq. 5.5 (Guo)
        middle = mi.Point2f(position) + 0.5 - radius * hidden * direction
        radius = dr.abs(radius) * (1 - hidden)  # Eq. 5.4
        view = lens.view(Pyramid(layer.color, size), radius)
        found = disk_mean(lens, view, middle, radius)
        color += through * rgb(found)
        through *= 1 - found.w
    return color / dr.maximum(1 - through, 1e-6)


def effective_limits(blurs: np.ndarray) -> tuple[Limits, float]:
    """The limits between the near, the in-focus and the far layer, and the blur radius of the near
    layer: the median over its surfaces.

    Parameters:
        blurs: Signed radii in pixels of the visible surfaces; any sample of the pixels.
    """
    near = blurs[blurs > IN_FOCUS]
    if near.size == 0:
        return Limits([0.0]), 0.0
    limit = (*split(near), IN_FOCUS)[0]
    return Limits([limit, 0.0]), float(np.median(near[near > limit]))
