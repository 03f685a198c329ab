"""The image that chains add their visits to."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ...rendering.filter_weights import put_splats
from .target import Contribution, Found


class ChainImage:
    """Two image blocks: visits of chains, whose factor is known in the end, and uniform samples.

    Parameters:
        film: It must be prepared, and accept splats.
    """

    def __init__(self, film: mi.Film) -> None:
        self._film = film
        self._blocks = [film.create_block(), film.create_block()]
        self._visits, self._uniform = self._blocks
        for block in self._blocks:
            # Positions of lanes have nothing to do with each other
            block.set_coalesce(False)

    def add(self, found: Contribution, weight: mi.Float) -> None:
        """Adds ``weight`` visits."""
        self._put(self._visits, found, weight)

    def add_uniform(self, found: Contribution, weight: mi.Float) -> None:
        """Adds uniform samples with this weight."""
        self._put(self._uniform, found, weight)

    def add_found(self, found: Found, weight: mi.Float) -> None:
        """Adds uniform samples, with the weights of their lanes, and evaluates the image."""
        dr.eval(weight)
        for part, lanes in zip(found.parts, found.lanes):
            self.add_uniform(part, dr.gather(mi.Float, weight, lanes, part.target > 0))
        dr.eval(self.tensors())

    def _put(self, block: mi.ImageBlock, found: Contribution, weight: mi.Float) -> None:
        value = found.value * weight
        # Neither alpha, nor weight, nor other variables: they come from camera rays
        others = [mi.Float(0)] * (block.channel_count() - 3)
        block.put(found.position, [value.x, value.y, value.z, *others], weight > 0)

    def add_tensors(self, tensors: Sequence[mi.TensorXf]) -> None:
        """Adds all of another image of this film: its :meth:`tensors`."""
        for block, tensor in zip(self._blocks, tensors):
            block.put_block(mi.ImageBlock(tensor, offset=block.offset()))
        dr.eval(self.tensors())

    def tensors(self) -> list[mi.TensorXf]:
        """What a launch evaluates."""
        return [block.tensor() for block in self._blocks]

    def _filtered(self, visits: mi.TensorXf) -> mi.TensorXf:
        return visits

    def write(self, visit_factor: float, uniform_factor: float, camera_spp: int) -> None:
        """Adds the image to the film, which holds ``camera_spp`` camera samples per pixel."""
        visits, uniform = self._filtered(self._visits.tensor()), self._uniform.tensor()
        tensor = visits * visit_factor + uniform * uniform_factor
        put_splats(self._film, tensor, self._visits.offset(), camera_spp)
