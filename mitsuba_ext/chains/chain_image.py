"""The image that chains add their visits to."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .target import Contribution

#: Intervals of the table of a filter's integral.
_TABLE = 1 << 14


class ChainImage:
    """Two image blocks: visits of chains, whose factor is known in the end, and uniform samples.

    Parameters:
        film: It must be prepared, and accept splats.
    """

    def __init__(self, film: mi.Film) -> None:
        self._film = film
        self._visits, self._uniform = film.create_block(), film.create_block()
        for block in (self._visits, self._uniform):
            # Positions of lanes have nothing to do with each other
            block.set_coalesce(False)

    def add(self, found: Contribution, weight: mi.Float) -> None:
        """Adds ``weight`` visits."""
        self._put(self._visits, found, weight)

    def add_uniform(self, found: Contribution, weight: mi.Float) -> None:
        """Adds uniform samples with this weight."""
        self._put(self._uniform, found, weight)

    def _put(self, block: mi.ImageBlock, found: Contribution, weight: mi.Float) -> None:
        value = found.value * weight
        # Neither alpha, nor weight, nor other variables: they come from camera rays
        others = [mi.Float(0)] * (block.channel_count() - 3)
        block.put(found.position, [value.x, value.y, value.z, *others], weight > 0)

    def tensors(self) -> list[mi.TensorXf]:
        """What a launch evaluates."""
        return [self._visits.tensor(), self._uniform.tensor()]

    def write(self, visit_factor: float, uniform_factor: float, camera_spp: int) -> None:
        """Adds the image to the film, which holds ``camera_spp`` camera samples per pixel."""
        visits, uniform = self.tensors()
        tensor = visits * visit_factor + uniform * uniform_factor
        if not self._film.rfilter().is_box_filter():
            # The film divides by the sum of the filter weights of its camera samples. That is a
            # random number, whose inverse is too large on average: leave its mean only
            weights = np.array(self._film.develop(raw=True))[..., self._weight_channel()]
            ratio = weights / (camera_spp * mean_weights(self._film))
            tensor *= mi.TensorXf(ratio[..., None].astype(np.float32))
        self._film.put_block(mi.ImageBlock(tensor, offset=self._visits.offset()))

    def _weight_channel(self) -> int:
        return 4 if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else 3


def mean_weights(film: mi.Film) -> np.ndarray:
    """The mean of the filter weights that one camera sample in each pixel adds to each pixel:
    [y, x]. Pixels at the edges get less, because there are no samples outside of the film."""
    rfilter = film.rfilter()
    radius = rfilter.radius()
    edges = np.linspace(-radius, radius, _TABLE + 1)
    values = rfilter.eval(mi.Float(0.5 * (edges[1:] + edges[:-1]))).numpy().astype(np.float64)
    integral = np.concatenate([[0], np.cumsum(values)]) * (2 * radius / _TABLE)

    def along(size: int) -> np.ndarray:
        centre = np.arange(size) + 0.5
        return np.interp(size - centre, edges, integral) - np.interp(-centre, edges, integral)

    width, height = film.crop_size()
    return along(height)[:, None] * along(width)
