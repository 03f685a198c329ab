"""The sums of the filter weights of samples, for each pixel and each label of samples.

Few labels occur in a pixel, but a scene may have thousands. The sums are therefore in a hash table
with open addressing, whose keys are pairs of a pixel and a label. A kernel finds or claims slots
with atomic compare-and-swap operations. Weights are added as integers: their sum does not depend on
the order, so the same samples always give exactly the same result.

Samples of a pixel follow each other, and most have the same label. A lane of the kernel therefore
adds up a run of samples for one row of the pixels around them, and looks for slots only where the
pixel or the label changes.

Source: D. E. Knuth, *The Art of Computer Programming*, volume 3, section 6.4 (open addressing).
"""

from __future__ import annotations

from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

#: The weight 1 as an integer, and the largest weight of a sample, so that 32 bits can hold it.
ONE, _MOST = 2.0**20, 2000.0

#: Slots for each pixel at the start. Keys of a pixel are there first, and then anywhere.
_SLOTS = 2

#: The length of the runs of samples that a lane adds up.
_RUN = 16

#: The number of slots after which the search for a key gives up, and the table grows.
_MOST_ATTEMPTS = 32


class _Sizes(NamedTuple):
    """The sizes of a table, as arrays of one number."""

    width: mi.UInt32
    height: mi.UInt32
    label_count: mi.UInt32
    slots: mi.UInt32


class PixelWeights:
    """Sums of weights, by pixel and label.

    Parameters:
        film: The film, whose reconstruction filter weights the samples.
        label_count: The number of labels.
    """

    def __init__(self, film: mi.Film, label_count: int) -> None:
        self._filter = film.rfilter()
        self._width, self._height = (int(x) for x in film.crop_size())
        self._offset = mi.ScalarPoint2f(film.crop_offset())
        self._label_count = max(1, label_count)
        self._pixel_count = self._width * self._height
        fits = self._pixel_count * self._label_count < 2**32 - 1
        self._type = mi.UInt32 if fits else mi.UInt64
        self._empty = 2**32 - 1 if fits else 2**64 - 1
        self.clear()

    def clear(self) -> None:
        """Forgets all samples."""
        self._slots, self._table = _SLOTS, self._no_keys(_SLOTS)

    def put(self, position: mi.Point2f, weight: mi.Float, label: mi.UInt32) -> None:
        """Adds samples.

        Parameters:
            position: Where the samples are on the film.
            weight: Their weights.
            label: Their labels.
        """
        dr.eval(position, weight, label)  # the table may have to grow, and take them again
        while True:
            keys, sums = (dr.copy(array) for array in self._table)
            lost = dr.zeros(mi.UInt32, 1)
            self._put(self._sizes(), self._table[0], keys, sums, lost, position, weight, label)
            dr.eval(keys, sums, lost)
            if int(lost[0]) == 0:
                self._table = keys, sums
                return
            self._grow()

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The pixels (row by row in the crop window), labels and sums of weights, sorted by pixel
        and label. Sums are integers: :data:`ONE` stands for 1."""
        keys, sums = (array.numpy() for array in self._table)
        is_used = keys != np.iinfo(keys.dtype).max
        keys, sums = keys[is_used], sums[is_used].astype(np.int64)
        order = np.argsort(keys)
        pixel, label = np.divmod(keys[order], keys.dtype.type(self._label_count))
        return pixel.astype(np.uint32), label.astype(np.uint32), sums[order]

    # ---- Helpers ----

    def _no_keys(self, slots: int) -> tuple[mi.UInt32 | mi.UInt64, mi.UInt64]:
        count = self._pixel_count * slots
        table = dr.full(self._type, self._empty, count), dr.zeros(mi.UInt64, count)
        dr.make_opaque(table)
        return table

    def _grow(self) -> None:
        old, is_lost = self._table, True
        while is_lost:
            self._slots *= 2
            self._table, lost = self._no_keys(self._slots), dr.zeros(mi.UInt32, 1)
            self._move(self._sizes(), self._no_keys(self._slots)[0], *old, *self._table, lost)
            dr.eval(self._table, lost)
            is_lost = int(lost[0]) > 0

    def _sizes(self) -> _Sizes:
        # Opaque, so that films and scenes share kernels
        numbers = self._width, self._height, self._label_count, self._slots
        return _Sizes(*(dr.opaque(mi.UInt32, number) for number in numbers))

    @dr.syntax
    def _claimed(self, sizes, known, keys, pixel, key, attempt, active):
        """The slot in which a key is looked for at an attempt, and whether it is, or becomes, the
        slot of the key.

        Parameters:
            known: The keys before this kernel. Most keys are there, and need no atomic operation.
            keys: The keys, to which new ones are added.
        """
        near = pixel * sizes.slots + attempt
        mixed = mi.UInt32(key) * 0x9E3779B1 + (pixel + attempt) * 0x85EBCA6B
        mixed = (mixed ^ mixed >> 15) * 0x2C1B3C6D
        far = dr.mul_hi(mixed ^ mixed >> 12, sizes.width * sizes.height * sizes.slots)
        slot = dr.select(attempt < _SLOTS, near, far)
        found = dr.gather(self._type, known, slot, active)
        is_mine = active & (found == key)
        if active & (found == self._empty):
            before, is_new = dr.scatter_cas(keys, self._type(self._empty), key, slot)
            is_mine = is_new | (before == key)
        return slot, is_mine

    @dr.syntax
    def _put(self, sizes, known, keys, sums, lost, position, weight, label):
        # How far from its own pixel a sample counts. Each lane has one row of the pixels around it
        reach = int(np.ceil(self._filter.radius() - 0.5))
        side = 2 * reach + 1
        count = dr.width(position, weight, label)
        end = dr.opaque(mi.UInt32, count)
        lane = dr.arange(mi.UInt32, -(-count // _RUN) * side)
        run = lane // side
        row = mi.Int32(lane - run * side) - reach
        index, left = run * _RUN, mi.UInt32(_RUN)
        # What the samples of the run have in common so far, and the sums for the pixels of the row
        pixel, run_label, totals = mi.Point2i(0), mi.UInt32(0), [mi.UInt64(0) for _ in range(side)]
        active = mi.Bool(True)
        while active:
            exists = (left > 0) & (index < end)
            p = dr.gather(mi.Point2f, position, index, exists) - self._offset
            its_pixel = mi.Point2i(dr.floor(p))
            its_pixel.y += row
            its_label = dr.gather(mi.UInt32, label, index, exists)
            share = dr.gather(mi.Float, weight, index, exists)
            from_center = mi.Point2f(its_pixel) - p + 0.5
            if dr.hint(side > 1, mode="scalar"):
                share *= self._filter.eval(from_center.y)
            ends = ~exists | dr.any(its_pixel != pixel) | (its_label != run_label)
            if ends:
                self._add_row(sizes, known, keys, sums, lost, pixel, run_label, totals)
            for column in range(side):
                x = from_center.x + (column - reach)
                value = share * self._filter.eval(x) if side > 1 else share
                totals[column] = dr.select(ends, 0, totals[column]) + _fixed(value)
            pixel, run_label = its_pixel, its_label
            index, left, active = index + 1, left - 1, active & exists

    @dr.syntax
    def _add_row(self, sizes, known, keys, sums, lost, pixel, label, totals):
        """Adds sums to the slots of the pixels in a row, whose middle is ``pixel``."""
        left, side = list(totals), len(totals)
        column, attempt, active = mi.UInt32(0), mi.UInt32(0), mi.Bool(True)
        while active:
            # Negative numbers are large ones here
            x, y = mi.UInt32(pixel.x - side // 2) + column, mi.UInt32(pixel.y)
            exists = active & (left[0] != 0) & (x < sizes.width) & (y < sizes.height)
            number = y * sizes.width + x
            key = self._type(number) * self._type(sizes.label_count) + self._type(label)
            slot, is_mine = self._claimed(sizes, known, keys, number, key, attempt, exists)
            dr.scatter_add(sums, left[0], slot, is_mine)
            gives_up = attempt == _MOST_ATTEMPTS
            dr.scatter(lost, mi.UInt32(1), mi.UInt32(0), exists & gives_up & ~is_mine)
            is_next = is_mine | gives_up | ~exists
            left = _rotated(left, is_next)
            attempt = dr.select(is_next, 0, attempt + 1)
            column += dr.select(is_next, 1, 0)
            active &= column < side

    @dr.syntax
    def _move(self, sizes, empty, old_keys, old_sums, keys, sums, lost):
        """Copies a smaller table."""
        attempt, active = mi.UInt32(0), old_keys != self._empty
        pixel = mi.UInt32(old_keys // self._type(sizes.label_count))
        while active:
            slot, is_mine = self._claimed(sizes, empty, keys, pixel, old_keys, attempt, active)
            dr.scatter(sums, old_sums, slot, is_mine)
            gives_up = attempt == _MOST_ATTEMPTS
            dr.scatter(lost, mi.UInt32(1), mi.UInt32(0), active & gives_up & ~is_mine)
            attempt += 1
            active &= ~is_mine & ~gives_up


def _rotated(numbers: list[mi.UInt64], active: mi.Bool) -> list[mi.UInt64]:
    """The list with the second element first, in ``active`` lanes."""
    return [dr.select(active, b, a) for a, b in zip(numbers, numbers[1:] + numbers[:1])]


def _fixed(weight: mi.Float) -> mi.UInt64:
    """A weight as an integer."""
    return mi.UInt64(mi.Int64(mi.Int32(dr.round(dr.clip(weight, -_MOST, _MOST) * ONE))))
