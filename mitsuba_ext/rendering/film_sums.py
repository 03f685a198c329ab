"""The sum of the contents of a film over several renders."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np


class FilmSums:
    """A film holds, for each pixel, the weighted sum of its samples and the sum of their weights.
    These sums are added over renders, which gives the film of a single render of all samples, for
    every reconstruction filter. The weights of some renders do not count the samples of the image
    (Markov chains, whose film holds a few camera samples as well). Of these renders the images are
    added, each times its samples per pixel.

    Attributes:
        contents: The sums, [height, width, channel], in double precision; 0.0 before the first.
        has_weights: Whether the film holds weights. A light tracer leaves an image without
            weights: the images are then added, each times its samples per pixel.
        spp: Samples per pixel of all renders.
    """

    def __init__(self) -> None:
        self.contents: np.ndarray | float = 0.0
        self.has_weights, self.spp = True, 0

    def add(self, film: mi.Film, spp: int, counts_samples: bool = True) -> None:
        """Adds the contents of the film after a render of ``spp`` samples per pixel.

        Args:
            counts_samples: Whether the film's weights count the samples of the image.
        """
        contents = np.array(film.develop(raw=True), dtype=np.float64)
        weights = contents[..., _weight_channel(film), None]
        self.has_weights = bool(weights.any())
        if self.has_weights and not counts_samples:
            contents = contents * (spp / np.where(weights == 0, 1, weights))
        self.contents = self.contents + (contents if self.has_weights else contents * spp)
        self.spp += spp

    def plus(self, other: FilmSums) -> FilmSums:
        """The sum over the renders of both."""
        total = FilmSums()
        total.contents = self.contents + other.contents
        total.has_weights = other.has_weights if other.spp else self.has_weights
        total.spp = self.spp + other.spp
        return total

    def fill(self, film: mi.Film, aov_names: Sequence[str]) -> None:
        """Replaces the contents of a film by the sums."""
        contents = self.contents if self.has_weights else self.contents / self.spp
        film.prepare(list(aov_names))
        tensor = mi.TensorXf(contents.astype(np.float32))
        film.put_block(mi.ImageBlock(tensor, offset=film.crop_offset()))


def _weight_channel(film: mi.Film) -> int:
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        return film.base_channels_count()
    return 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3
