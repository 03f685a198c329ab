"""Mean and variance of the samples of each pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..util.discrete_sampling import first_above

#: The weight of a pixel's neighbourhood, in units of the pixel's own samples. A few samples say
#: little about rare bright values of a pixel; its neighbours add information.
_NEIGHBOURS = 16.0

#: Added to the squared brightness of a pixel, in units of the squared mean of all pixels, as in
#: relMSE.
_FLOOR = 1e-2


class PixelMoments:
    """Mean and variance of the samples of each pixel, on the device.

    Parameters:
        width, height: Size of the film in pixels.
        set_size: Number of samples that a stratified sampler distributes together. The variance is
            that of the means of sets, times this number.

    Attributes:
        count (mi.UInt32): Number of samples of each pixel, row by row.
        total (int): Number of samples of all pixels.
    """

    def __init__(self, width: int, height: int, set_size: int = 1) -> None:
        self._size, self._set_size = (width, height), set_size
        self.count, self.total = dr.zeros(mi.UInt32, width * height), 0
        self._sum, self._squares = (dr.zeros(mi.Float64, width * height) for _ in range(2))

    @property
    def pixel_count(self) -> int:
        return self._size[0] * self._size[1]

    def add(self, pixel: mi.UInt32, values: mi.Float) -> None:
        """Adds the sets of a pass. ``pixel`` holds the pixel of each set, in ascending order, and
        ``values`` the brightness of their samples, set by set. Samples that are not finite count
        as black."""
        values = mi.Float64(dr.select(dr.isfinite(values), values, 0))
        values = dr.block_sum(values, self._set_size) / self._set_size
        dr.eval(pixel, values)
        # A lane for each pixel, which adds in a fixed order: equal seeds give equal sums
        number = len(pixel)
        of_lane, last = dr.arange(mi.UInt32, self.pixel_count), dr.opaque(mi.UInt32, number)
        longest = 1 << 8 * -(-number.bit_length() // 8)  # few different numbers of steps
        begin, end = (
            first_above(pixel, mi.UInt32(0), last, x, mi.Bool(True), longest, reaches=True)
            for x in (of_lane, of_lane + 1)
        )
        total, squares = _sums(values, begin, end)
        self._sum += total
        self._squares += squares
        self.count += (end - begin) * dr.opaque(mi.UInt32, self._set_size)
        self.total += number * self._set_size
        dr.eval(self._sum, self._squares, self.count)

    def deviation(self) -> mi.Float64:
        """The standard deviation of one sample of each pixel, relative to its brightness.

        Each sample is part of the mean by which its deviation is divided. The influence of a rare
        bright sample is thereby bounded: by the number of samples."""
        sets = mi.Float64(self.count) / dr.opaque(mi.Float64, self._set_size)
        mean = self._sum / dr.maximum(sets, 1)
        # The variance of a single set is unknown: such a pixel only uses its neighbourhood
        variance = dr.maximum(self._squares - sets * dr.square(mean), 0) / dr.maximum(sets - 1, 1)
        dr.eval(mean, variance)
        average = dr.sum(mean) / dr.opaque(mi.Float64, self.pixel_count)
        own, square = dr.select(sets > 1, sets, 0), dr.square(mean)
        top = own * variance + _NEIGHBOURS * self._neighbours(variance)
        bottom = own * square + _NEIGHBOURS * self._neighbours(mean, squared=True)
        # In a black image, the deviation is 0
        floor = (own + _NEIGHBOURS) * _FLOOR * dr.square(average)
        scale = dr.maximum(bottom + floor, 1e-30)
        return dr.sqrt(dr.opaque(mi.Float64, self._set_size) * top / scale)

    def _neighbours(self, values: mi.Float64, squared: bool = False) -> mi.Float64:
        """The mean over each pixel and the eight around it, or of their squares."""
        width, height = (dr.opaque(mi.Int32, x) for x in self._size)
        index = dr.arange(mi.Int32, self.pixel_count)
        y = index // width
        x, result = index - y * width, mi.Float64(0)
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                # Pixels outside are like those at the edge
                near = dr.clip(y + down, 0, height - 1) * width + dr.clip(x + right, 0, width - 1)
                value = dr.gather(mi.Float64, values, mi.UInt32(near))
                result += dr.square(value) if squared else value
        return result / 9


@dr.syntax
def _sums(values: mi.Float64, begin: mi.UInt32, end: mi.UInt32) -> tuple[mi.Float64, mi.Float64]:
    """The sums of the values [begin, end), and of their squares."""
    total, squares, index = mi.Float64(0), mi.Float64(0), mi.UInt32(begin)
    while index < end:
        value = dr.gather(mi.Float64, values, index)
        total += value
        squares += dr.square(value)
        index += 1
    return total, squares
