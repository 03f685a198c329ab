"""The images of single passes, and the variance that they show."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .filter_weights import expected_weights, share_of_squares, shares_of_pixels

#: The fewest passes of a stage whose images are wanted. A variance needs two images.
FEWEST_PASSES = 3


class PassImages:
    """Mean and variance of each pixel in one stage or several, from the images of their passes.

    Passes are independent: their differences show the variance of all that a stage adds to the
    film, splats included, without a change to its kernel.

    Parameters:
        film: The film. Special ones, which hold no colours, have no images.

    Attributes:
        count: The number of images.
    """

    def __init__(self, film: mi.Film) -> None:
        self._film, self.count = film, 0
        self._is_special = mi.has_flag(film.flags(), mi.FilmFlags.Special)
        self._before: tuple[mi.Float64, mi.Float64, mi.Float64] | None = None
        self._weights: mi.Float64 | None = None
        self._spp_before = self._spp = 0
        self._mean, self._squares = mi.Float64(0), mi.Float64(0)

    def begin(self, block: mi.ImageBlock, splats: mi.ImageBlock | None, spp: int) -> None:
        """Called before the first pass of a stage, with the sums of all samples until then, and
        their number for each pixel."""
        if not self._is_special:
            self._before, self._spp_before = self._sums(block, splats), spp

    def add(
        self, block: mi.ImageBlock, splats: mi.ImageBlock | None, spp: int, count: float
    ) -> None:
        """Called after each pass, as :meth:`begin`. ``count`` is the weight of its samples."""
        if self._is_special:
            return
        now = self._sums(block, splats)
        colour, weight, splatted = (x - y for x, y in zip(now, self._before))
        own, self._before, self._spp_before = spp - self._spp_before, now, spp
        image = colour / dr.select(weight == 0, 1, weight)
        if self._weights is None:
            self._weights = expected_weights(self._film)
        image += splatted / (dr.opaque(mi.Float64, own * count) * self._weights)
        image = dr.select(dr.isfinite(image), image, 0)
        # Welford's update, weighted by the samples of the pass
        self.count, self._spp = self.count + 1, self._spp + own
        deviation = image - self._mean
        self._mean += deviation * dr.opaque(mi.Float64, own / self._spp)
        self._squares += dr.opaque(mi.Float64, own) * deviation * (image - self._mean)
        dr.eval(self._mean, self._squares, self._weights)

    def _sums(
        self, block: mi.ImageBlock, splats: mi.ImageBlock | None
    ) -> tuple[mi.Float64, mi.Float64, mi.Float64]:
        """For each pixel, row by row: the sums of colours, of filter weights, and of splats."""
        alpha = 4 if mi.has_flag(self._film.flags(), mi.FilmFlags.Alpha) else 3
        sums = (
            _colour(block), mi.Float64(_channel(block, alpha)),
            mi.Float64(0) if splats is None else _colour(splats),
        )  # fmt: skip
        dr.eval(sums)
        return sums

    def mean(self) -> mi.Float64:
        """The radiance of each pixel, row by row."""
        return self._mean

    def variance(self) -> mi.Float64:
        """An estimate of the variance of one sample of each pixel, row by row, from two images or
        more.

        A filter that is wider than a pixel averages the samples of several pixels. Their variances
        are assumed to be about equal. The contrast between them is noise of the film, too, but not
        of the samples of a pixel: it is taken from the mean."""
        share = (self.count - 1) * share_of_squares(self._film)
        variance = self._squares / dr.opaque(mi.Float64, share)
        return dr.maximum(variance - self._contrast(), 0)

    def _contrast(self) -> mi.Float64:
        """The mean squared difference of each pixel to those around, weighted as by the squared
        filter."""
        shares = shares_of_pixels(self._film)
        radius, size = len(shares) // 2, self._film.crop_size()
        width, height = (dr.opaque(mi.Int32, int(x)) for x in size)
        index = dr.arange(mi.Int32, len(self._mean))
        y = index // width
        x, result = index - y * width, mi.Float64(0)
        for row, of_row in enumerate(shares):
            for column, share in enumerate(of_row):
                # Pixels outside are like those at the edge
                near_x = dr.clip(x + (column - radius), 0, width - 1)
                near_y = dr.clip(y + (row - radius), 0, height - 1)
                near = dr.gather(mi.Float64, self._mean, mi.UInt32(near_y * width + near_x))
                result += float(share) * dr.square(near - self._mean)
        return result


def _channel(block: mi.ImageBlock, channel: int) -> mi.Float:
    values = dr.detach(block.tensor().array)
    count = block.channel_count()
    pixel = dr.arange(mi.UInt32, len(values) // count)
    return dr.gather(mi.Float, values, pixel * count + channel)


def _colour(block: mi.ImageBlock) -> mi.Float64:
    """The mean of the three channels of colour."""
    return sum(mi.Float64(_channel(block, channel)) for channel in range(3)) * (1 / 3)
