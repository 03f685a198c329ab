"""Finds the records near a point, and interpolates between them, in kernels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import from_numpy
from .records import Records

#: The most levels of cells, and words of a record: place, reach, normal and level in two packets
#: of four; then, for each channel, E and its two gradients in two packets.
_MOST_LEVELS, _PACKET = 24, 4

#: How far a point may lie behind a record, in units of its reach times the accuracy.
_BEHIND = 0.2


class RecordGrid:
    """The records in a hash grid of several levels.

    Cells of a level are twice as wide as its records are valid, so that a record lies in at most
    eight of them. A point looks at one cell of each level.

    Parameters:
        records: The records; may be empty.
        accuracy: a of Eq. 10.9: a record is valid where its error ε is smaller.
    """

    def __init__(self, records: Records, accuracy: float) -> None:
        count, self._channels = len(records), records.irradiance.shape[1]
        self._accuracy = dr.opaque(mi.Float, accuracy)
        radius = accuracy * records.reach.astype(np.float64)
        least = float(radius.min()) if count else 1.0
        level = np.floor(np.log2(np.maximum(radius / least, 1)) + 1e-9).astype(np.int64)
        level = np.minimum(level, _MOST_LEVELS - 1)
        # Radii of level 0 are up to 2 · least; a little wider, as kernels round otherwise
        width = 4.02 * least
        self._width = dr.opaque(mi.Float, width)
        self._levels = dr.opaque(mi.UInt32, int(level.max()) + 1 if count else 0)
        buckets = 1 << max(4, (8 * count - 1).bit_length())
        self._mask = dr.opaque(mi.UInt32, buckets - 1)
        starts, entries = _sorted(records.p, radius, level, width, buckets)
        self._starts = from_numpy(mi.UInt32, starts)
        # Never empty: a masked gather from an empty array is an error
        self._entries = from_numpy(mi.UInt32, entries if len(entries) else [0])
        self._records = from_numpy(mi.Float, _packed(records, level))
        dr.eval(self._starts, self._entries, self._records)

    def kernel_state(self) -> tuple:
        """What kernels depend on."""
        return (
            self._channels, self._accuracy, self._width, self._levels, self._mask, self._starts,
            self._entries, self._records,
        )  # fmt: skip

    @dr.syntax
    def interpolated(
        self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Bool]:
        """The irradiance at a point, and whether any record is valid there."""
        total, weights = mi.Spectrum(0), mi.Float(0)
        level, place, end = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)
        searches = active & (self._levels > 0)
        while dr.hint(searches, label="interpolate"):
            # ----- Go on to the cell of the next level if this one is at its end -----
            is_new = place >= end
            bucket = self._bucket(p, level)
            start = dr.gather(mi.UInt32, self._starts, bucket, searches & is_new)
            stop = dr.gather(mi.UInt32, self._starts, bucket + 1, searches & is_new)
            place, end = dr.select(is_new, start, place), dr.select(is_new, stop, end)
            level += dr.select(is_new, 1, 0)

            # ----- Look at the next record -----
            exists = searches & (place < end)
            index = dr.gather(mi.UInt32, self._entries, place, exists)
            weight = self._weight(index, p, n, level - 1, exists)
            is_valid = exists & (weight > 0)
            E = self._extrapolated(index, p, n, is_valid)
            total += dr.select(is_valid, weight * E, 0)
            weights += dr.select(is_valid, weight, 0)
            place += dr.select(exists, 1, 0)
            searches = searches & ((place < end) | (level < self._levels))
        found = weights > 0
        return total * dr.select(found, dr.rcp(weights), 0), found

    def _bucket(self, p: mi.Point3f, level: mi.UInt32) -> mi.UInt32:
        width = self._width * mi.Float(mi.UInt32(1) << level)
        cell = mi.Vector3i(dr.floor(mi.Vector3f(p) / width))
        return _hash(mi.UInt32(cell.x), mi.UInt32(cell.y), mi.UInt32(cell.z), level) & self._mask

    def _weight(
        self, index: mi.UInt32, p: mi.Point3f, n: mi.Normal3f, level: mi.UInt32, active: mi.Bool
    ) -> mi.Float:
        """The weight of a record: 1/ε − 1/a, positive where ε < a, so that nothing jumps where a
        record ceases to be valid."""
        row = index * (2 + 2 * self._channels)
        first = dr.gather(mi.Vector4f, self._records, row, active)
        second = dr.gather(mi.Vector4f, self._records, row + 1, active)
        way = mi.Vector3f(p.x - first.x, p.y - first.y, p.z - first.z)
        normal = mi.Vector3f(second.x, second.y, second.z)
        # Eq. 10.8. Of a point exactly at a record, ε would be 0
        change = dr.norm(way) * first.w + dr.safe_sqrt(1 - dr.dot(n, normal))
        change = dr.maximum(change, 0.02 * self._accuracy)
        # Points behind a record see what it does not (Ward et al. 1988)
        height = dr.dot(way, n + normal) * 0.5
        is_valid = height * first.w > -_BEHIND * self._accuracy
        # Cells of two levels may share a bucket
        is_valid &= second.w == mi.Float(level)
        return dr.select(is_valid, dr.rcp(change) - dr.rcp(self._accuracy), 0)

    def _extrapolated(
        self, index: mi.UInt32, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool
    ) -> mi.Spectrum:
        """E + (n_i × n) · ∇_r E + (x − x_i) · ∇_t E, not negative."""
        row = index * (2 + 2 * self._channels)
        first = dr.gather(mi.Vector4f, self._records, row, active)
        second = dr.gather(mi.Vector4f, self._records, row + 1, active)
        way = mi.Vector3f(p.x - first.x, p.y - first.y, p.z - first.z)
        turn = dr.cross(mi.Vector3f(second.x, second.y, second.z), mi.Vector3f(n))
        E = mi.Spectrum(0)
        for channel in range(self._channels):
            one = dr.gather(mi.Vector4f, self._records, row + 2 + 2 * channel, active)
            two = dr.gather(mi.Vector4f, self._records, row + 3 + 2 * channel, active)
            value = one.w + dr.dot(mi.Vector3f(one.x, one.y, one.z), turn)
            value += dr.dot(mi.Vector3f(two.x, two.y, two.z), way)
            E[channel] = dr.maximum(value, 0)
        return E


def _packed(records: Records, level: np.ndarray) -> np.ndarray:
    """The words of the records; one row of zeros if there are none."""
    count, channels = records.irradiance.shape
    rows = np.zeros((max(count, 1), 2 + 2 * channels, _PACKET), np.float32)
    if count:
        rows[:, 0, :3], rows[:, 0, 3] = records.p, 1 / records.reach
        rows[:, 1, :3], rows[:, 1, 3] = records.n, level
        rows[:, 2::2, :3], rows[:, 2::2, 3] = records.rotation, records.irradiance
        rows[:, 3::2, :3] = records.translation
    return rows


def _sorted(
    p: np.ndarray, radius: np.ndarray, level: np.ndarray, width: float, buckets: int
) -> tuple[np.ndarray, np.ndarray]:
    """The first entry of each bucket, and the entries: the records, by bucket and by number."""
    count = len(p)
    widths = (width * 2.0**level)[:, None]
    low = np.floor((p - 1.001 * radius[:, None]) / widths).astype(np.int64)
    high = np.floor((p + 1.001 * radius[:, None]) / widths).astype(np.int64)
    pairs = []
    for corner in range(8):
        bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1], bool)
        cell = np.where(bits, high, low).astype(np.uint32)
        bucket = _hash(cell[:, 0], cell[:, 1], cell[:, 2], level.astype(np.uint32))
        pairs.append((bucket & np.uint32(buckets - 1)).astype(np.int64) * count + np.arange(count))
    # A record is once in each bucket
    pairs = np.unique(np.concatenate(pairs))
    sizes = np.bincount(pairs // max(count, 1), minlength=buckets)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return starts.astype(np.uint32), (pairs % max(count, 1)).astype(np.uint32)


def _hash(x, y, z, level):
    """A number for a cell; of arrays of Dr.Jit or NumPy."""
    kind = np.uint32 if isinstance(x, np.ndarray) else int
    primes = (kind(k) for k in (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F))
    a, b, c, d = primes
    word = (x * a) ^ (y * b) ^ (z * c) ^ (level * d)
    word = (word ^ (word >> kind(15))) * kind(0x2C1B3C6D)
    return word ^ (word >> kind(12))
