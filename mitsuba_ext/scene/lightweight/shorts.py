"""Tables of 16-bit numbers on the device, two per word."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy

#: The largest 16-bit number.
LARGEST = (1 << 16) - 1


class Pairs:
    """Two numbers for each entry.

    Parameters:
        values: Shape (entries, 2), uint16.
    """

    def __init__(self, values: np.ndarray) -> None:
        self._words = from_numpy(mi.UInt32, np.ascontiguousarray(values).view("<u4").ravel())
        self.nbytes = values.nbytes

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        word = dr.gather(mi.UInt32, self._words, index, active)
        return word & LARGEST, word >> 16


class Triples:
    """Three numbers for each entry.

    Parameters:
        values: Shape (entries, 3), uint16.
    """

    def __init__(self, values: np.ndarray) -> None:
        # Padded to an even count
        padded = np.zeros(values.size + values.size % 2, dtype="<u2")
        padded[: values.size] = values.ravel()
        self._words = from_numpy(mi.UInt32, padded.view("<u4"))
        self.nbytes = padded.nbytes

    def __call__(self, index: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, ...]:
        # An entry begins in the lower or in the upper half of a word
        first = 3 * index >> 1
        a = dr.gather(mi.UInt32, self._words, first, active)
        b = dr.gather(mi.UInt32, self._words, first + 1, active)
        is_upper = (index & 1) == 1
        low_a, high_a, low_b, high_b = a & LARGEST, a >> 16, b & LARGEST, b >> 16
        return (
            dr.select(is_upper, high_a, low_a),
            dr.select(is_upper, low_b, high_a),
            dr.select(is_upper, high_b, low_b),
        )


class Quantizer:
    """Represents numbers by 16 bits between their smallest and their largest value.

    Parameters:
        values: Shape (entries, components).
    """

    def __init__(self, values: np.ndarray) -> None:
        self._low = values.min(axis=0).astype(np.float32)
        self._step = ((values.max(axis=0) - self._low) / LARGEST).astype(np.float32)
        self._on_device = [mi.Float(x) for x in (*self._low.tolist(), *self._step.tolist())]
        dr.make_opaque(self._on_device)  # other meshes share the kernel

    def encode(self, values: np.ndarray) -> np.ndarray:
        """The nearest numbers that can be represented. Shape (entries, components), uint16."""
        step = np.where(self._step > 0, self._step, 1)
        return np.clip(np.rint((values - self._low) / step), 0, LARGEST).astype(np.uint16)

    def decode(self, numbers: tuple[mi.UInt32, ...]) -> list[mi.Float]:
        """The components of entries on the device."""
        low, step = self._on_device[: len(numbers)], self._on_device[len(numbers) :]
        return [dr.fma(mi.Float(n), s, x) for n, s, x in zip(numbers, step, low)]
