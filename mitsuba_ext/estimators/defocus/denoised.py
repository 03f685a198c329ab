"""Denoises layers before a filter blurs them."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...images.denoising import denoiser
from .images import Size, filled
from .layers import LayerSums


def denoised(sums: LayerSums, size: Size) -> LayerSums:
    """A layer with colours denoised by Open Image Denoise, guided by albedo and normal.

    A denoiser works less well on an image blurred by a lens, because its guides are also blurred
    and noisy. Before the filter, the guides are sharp. Holes of the layer are filled first, so that
    they have no edges. Pixels that show a light are unchanged.

    Parameters:
        sums: The layer, with guides.
        size: The size of the layer.

    Raises:
        InstallationError: The package ``mitsuba-oidn`` is missing.
    """
    if not sums.is_there:
        return sums
    is_known = sums.hits > 1e-6
    scale = dr.select(is_known, dr.rcp(dr.select(is_known, sums.hits, 1)), 0)
    weight = dr.select(is_known, mi.Float(1), 0)

    def picture(values: list[mi.Float]) -> np.ndarray:
        packed = dr.ravel(mi.Vector4f(*(value * scale for value in values), 0))
        whole = filled(mi.Vector4f, packed, weight, size).numpy()
        return np.ascontiguousarray(whole.reshape(size.height, size.width, 4)[..., :3])

    color = picture(list(sums.color))
    result = np.array(denoiser().denoise(
        color, albedo=picture(sums.guides[:3]), normal=picture(sums.guides[3:6]), hdr=True
    ))  # fmt: skip
    found = mi.Color3f(np.ascontiguousarray(result.reshape(-1, 3).T))
    found *= dr.select(is_known, sums.hits, 0)
    # Lights have no noise, and a denoiser would brighten small ones
    return replace(sums, color=dr.select(sums.guides[6] > 0, sums.color, found))
