"""The image to which chains add visits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ...rendering.filter_weights import put_splats
from ...util.stored_arrays import StoredArrays
from .target import Contribution, Found


class ChainImage:
    """Two image blocks: the visits of chains, whose scale is known only at the end, and independent
    samples.

    Parameters:
        film: The film, which must be prepared and accept splats.
    """

    def __init__(self, film: mi.Film) -> None:
        self._film = film
        self._blocks = [film.create_block(), film.create_block()]
        self._visits, self._uniform = self._blocks
        for block in self._blocks:
            # Neighbouring lanes have unrelated positions
            block.set_coalesce(False)

    def add(self, found: Contribution, weight: mi.Float) -> None:
        """Adds ``weight`` visits."""
        self._put(self._visits, found, weight)

    def add_uniform(self, found: Contribution, weight: mi.Float) -> None:
        """Adds independent samples with this weight."""
        self._put(self._uniform, found, weight)

    def add_found(self, found: Found, weight: mi.Float) -> None:
        """Adds independent samples, with the weights of their lanes, and evaluates the image."""
        dr.eval(weight)
        for part, lanes in zip(found.parts, found.lanes):
            self.add_uniform(part, dr.gather(mi.Float, weight, lanes, part.target > 0))
        dr.eval(self.tensors())

    def _put(self, block: mi.ImageBlock, found: Contribution, weight: mi.Float) -> None:
        value = found.value * weight
        # Alpha, weight and AOVs come from camera rays only
        others = [mi.Float(0)] * (block.channel_count() - 3)
        block.put(found.position, [value.x, value.y, value.z, *others], weight > 0)

    def add_tensors(self, tensors: Sequence[mi.TensorXf]) -> None:
        """Adds another image of this film, given by its :meth:`tensors`."""
        for block, tensor in zip(self._blocks, tensors):
            block.put_block(mi.ImageBlock(tensor, offset=block.offset()))
        dr.eval(self.tensors())

    def restore(self, stored: StoredArrays, names: Sequence[str]) -> None:
        """Adds the tensors of an image of this film from a file.

        Raises:
            DamagedError: The tensors have a different size.
        """
        shapes = [tensor.shape for tensor in self.tensors()]
        arrays = (
            stored.take(name, "f", shape, longest=math.prod(shape))
            for name, shape in zip(names, shapes)
        )
        self.add_tensors([mi.TensorXf(array) for array in arrays])

    def tensors(self) -> list[mi.TensorXf]:
        """The pixels of each block. A kernel launch evaluates them."""
        return [block.tensor() for block in self._blocks]

    def _filtered(self, visits: mi.TensorXf) -> mi.TensorXf:
        return visits

    def write(self, visit_factor: float, uniform_factor: float, camera_spp: int) -> None:
        """Adds the image to the film, which holds ``camera_spp`` camera samples per pixel."""
        visits, uniform = self._filtered(self._visits.tensor()), self._uniform.tensor()
        tensor = visits * visit_factor + uniform * uniform_factor
        put_splats(self._film, tensor, self._visits.offset(), camera_spp)
