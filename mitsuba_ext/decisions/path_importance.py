"""By how much errors of paths count in an image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Paths that follow each other, and so begin close together: their mean is what errors are
#: relative to, but for this share of the squared mean of all.
_NEIGHBOURS, _FLOOR = 64, 1e-2


def brightness(L: mi.Spectrum) -> mi.Float:
    """One number for a path's radiance: errors count the same in all channels."""
    return dr.mean(L)


def importance(total: mi.Float) -> tuple[mi.Float, mi.Float]:
    """For each path, by how much squared errors count at its place in the image, and its own
    squared error, weighted so. ``total`` is what each path of a pass brought, in order."""
    total = dr.select(dr.isfinite(total), total, 0)
    path = dr.arange(mi.UInt32, -(-len(total) // _NEIGHBOURS) * _NEIGHBOURS)
    # The last group is filled up from the beginning
    filled = dr.gather(mi.Float, total, path % dr.opaque(mi.UInt32, len(total)))
    mean = dr.repeat(dr.block_sum(filled, _NEIGHBOURS) / _NEIGHBOURS, _NEIGHBOURS)
    mean = dr.gather(mi.Float, mean, dr.arange(mi.UInt32, len(total)))
    weight = dr.rcp(dr.square(mean) + _FLOOR * dr.square(dr.mean(total)) + 1e-30)
    return weight, dr.square(total - mean) * weight
