"""Image blocks for samples of layers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .images import Size
from .layers import LayerSums, Limits
from .pinhole import Surface

#: The numbers of channels of each layer (RGB, alpha, blur, hits, blur times brightness) and of a
#: denoiser's features.
_VALUES, _GUIDES = 7, 7


class LayerBlocks:
    """Image blocks that collect the layers' samples.

    Parameters:
        film: The film whose reconstruction filter is used. With guides, a box filter is used
            instead, because a denoiser mistakes noise that neighbouring pixels share for detail.
        size, offset: The size of the blocks, and the position of their corner on the film.
        limits: The limits of the layers.
        has_guides: Whether surfaces have the features of a denoiser (:attr:`Surface.guides`).
    """

    def __init__(
        self, film: mi.Film, size: Size, offset: list[int], limits: Limits, has_guides: bool = False
    ) -> None:
        self.limits, self._has_guides = limits, has_guides
        self._channels = _VALUES + (_GUIDES if has_guides else 0)
        count = limits.layer_count
        rfilter = mi.load_dict({"type": "box"}) if has_guides else film.rfilter()

        def block(channels: int) -> mi.ImageBlock:
            area = [size.width, size.height]
            return mi.ImageBlock(area, offset, channels, rfilter, coalesce=False)

        self._hits = [block(self._channels) for _ in range(count)]
        self._known = block(count)

    def put(
        self,
        position: mi.Point2f,
        color: mi.Color3f,
        alpha: mi.Float,
        surface: Surface,
        weight: mi.Float,
        active: mi.Bool,
        behind: mi.Float | None = None,
    ) -> None:
        """Adds samples.

        Parameters:
            surface: The surface that each sample hit.
            behind: Samples are added only to layers behind the layer of this blur; infinity for
                all.
        """
        known, blur = [], surface.blur
        for k, block in enumerate(self._hits):
            is_open = active
            if behind is not None:
                is_open = active & (dr.isinf(behind) | ~self.limits.is_before(k, behind))
            is_hit = is_open & self.limits.contains(k, blur)
            values = [
                color.x, color.y, color.z, alpha, blur, mi.Float(1), blur * dr.sum(color),
                *surface.guides,
            ]  # fmt: skip
            block.put(position, [weight * value for value in values], is_hit)
            known.append(dr.select(is_open & self.limits.is_before(k, blur), weight, 0))
        self._known.put(position, known, active)

    def tensors(self) -> list[mi.TensorXf]:
        return [block.tensor() for block in (*self._hits, self._known)]

    def sums(self) -> tuple[list[LayerSums], list[mi.Float]]:
        """The sums of each layer, and the sums of alpha."""
        known = self._known.tensor()
        count, channels = self.limits.layer_count, self._channels
        lane = dr.arange(mi.UInt32, len(known.array) // count)
        sums, alphas = [], []
        for k, block in enumerate(self._hits):
            values = block.tensor().array
            v = [dr.gather(mi.Float, values, channels * lane + i) for i in range(channels)]
            sums.append(LayerSums(
                mi.Color3f(*v[:3]), v[4], v[5],
                dr.gather(mi.Float, known.array, count * lane + k), v[_VALUES:],
                (v[6], v[0] + v[1] + v[2]), self.limits.shared(k),
            ))  # fmt: skip
            alphas.append(v[3])
        return sums, alphas
