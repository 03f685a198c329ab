"""The images of single passes, and the variance that they show."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .filter_weights import mean_weights, share_of_squares, shares_of_pixels

#: The fewest passes of a stage whose images are wanted. A variance needs two images.
FEWEST_PASSES = 3


class PassImages:
    """Mean and variance of each pixel in one stage or several, from the images of their passes.

    Passes are independent: their differences show the variance of all that a stage adds to the
    film, splats included, without a change to its kernel.

    Parameters:
        film: The film. Special ones, which hold no colours, have no images.
    """

    def __init__(self, film: mi.Film) -> None:
        self._film = film
        self._is_special = mi.has_flag(film.flags(), mi.FilmFlags.Special)
        self._before: tuple[np.ndarray, np.ndarray, int] | None = None
        self._images: list[np.ndarray] = []
        self._spp: list[int] = []

    @property
    def count(self) -> int:
        """The number of images."""
        return len(self._images)

    def begin(self, block: mi.ImageBlock, splats: mi.ImageBlock | None, spp: int) -> None:
        """Called before the first pass of a stage, with the sums of all samples until then, and
        their number for each pixel."""
        if self._is_special:
            return
        sums = _contents(block)
        splatted = np.zeros_like(sums) if splats is None else _contents(splats)
        self._before = sums, splatted, spp

    def add(self, block: mi.ImageBlock, splats: mi.ImageBlock | None, spp: int) -> None:
        """Called after each pass, as :meth:`begin`."""
        if self._is_special:
            return
        before, splatted_before, spp_before = self._before
        self.begin(block, splats, spp)
        sums, splatted, _ = self._before
        image = self._image(sums - before, splatted - splatted_before, spp - spp_before)
        self._images.append(np.where(np.isfinite(image), image, 0))
        self._spp.append(spp - spp_before)

    def _image(self, sums: np.ndarray, splatted: np.ndarray, spp: int) -> np.ndarray:
        weight = sums[..., 4 if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else 3]
        colour = sums[..., :3].mean(axis=2) / np.where(weight == 0, 1, weight)
        return colour + splatted[..., :3].mean(axis=2) / (spp * mean_weights(self._film))

    def mean(self) -> np.ndarray:
        """The radiance of each pixel, [y, x]."""
        return np.average(self._images, axis=0, weights=self._spp)

    def variance(self) -> np.ndarray:
        """An estimate of the variance of one sample of each pixel, [y, x], from two images or more.

        A filter that is wider than a pixel averages the samples of several pixels. Their variances
        are assumed to be about equal. The contrast between them is noise of the film, too, but not
        of the samples of a pixel: it is taken from the mean."""
        spp, mean = np.array(self._spp)[:, None, None], self.mean()
        squares = (spp * (np.array(self._images) - mean) ** 2).sum(axis=0) / (self.count - 1)
        return np.maximum(squares / share_of_squares(self._film) - self._contrast(mean), 0)

    def _contrast(self, mean: np.ndarray) -> np.ndarray:
        """The mean squared difference of each pixel to those around, weighted as by the squared
        filter."""
        shares = shares_of_pixels(self._film)
        radius = len(shares) // 2
        padded = np.pad(mean, radius, mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, shares.shape)
        return (shares * (around - mean[..., None, None]) ** 2).sum(axis=(2, 3))


def _contents(block: mi.ImageBlock) -> np.ndarray:
    return np.array(block.tensor(), dtype=np.float64)
