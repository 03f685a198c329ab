"""Finds the records near a point, and interpolates between them, in kernels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from .records import Records

#: The most levels of cells, and words of a packet, which a kernel reads at once. A record has two
#: of place, reach, normal and level; then, for each channel, two of E and its gradients.
_MOST_LEVELS, _PACKET = 24, 4

#: How far a point may lie behind a record (in the direction of their mean normal), and how far from
#: its tangent plane, in units of its radius.
_BEHIND, _BESIDE = 0.2, 0.6


class RecordGrid:
    """The records in a hash grid of several levels.

    Cells of a level are one to two times as wide as its records are valid. A record is listed in
    each cell that it can serve, at most 27 of them. A point looks at one cell of each level.

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
        # Radii of level 0 are up to 2 · least; a little wider because kernels round differently
        width = 2.01 * least
        self._width = dr.opaque(mi.Float, width)
        self._levels = dr.opaque(mi.UInt32, int(level.max()) + 1 if count else 0)
        buckets = 1 << max(4, (16 * count - 1).bit_length())
        self._mask = dr.opaque(mi.UInt32, buckets - 1)
        starts, entries = _sorted(records, radius, level, width, buckets)
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
        goes_on = active & (self._levels > 0)
        while dr.hint(goes_on, label="interpolate"):
            # Lanes of a kernel search for different times. All wait here, and then read gradients
            index, weight, searches = mi.UInt32(0), mi.Float(0), mi.Bool(goes_on)
            while dr.hint(searches, label="search"):
                # ----- Go on to the cell of the next level if this one is at its end -----
                is_new = searches & (place >= end)
                bucket = self._bucket(p, level)
                start = dr.gather(mi.UInt32, self._starts, bucket, is_new)
                stop = dr.gather(mi.UInt32, self._starts, bucket + 1, is_new)
                place, end = dr.select(is_new, start, place), dr.select(is_new, stop, end)
                level += dr.select(is_new, 1, 0)

                # ----- Look at the next record -----
                exists = searches & (place < end)
                index = dr.gather(mi.UInt32, self._entries, place, exists)
                weight = self._weight(index, p, n, level - 1, exists)
                place += dr.select(exists, 1, 0)
                goes_on = (place < end) | (level < self._levels)
                searches = searches & goes_on & (weight <= 0)
            is_valid = weight > 0
            E = self._extrapolated(index, p, n, is_valid)
            total += dr.select(is_valid, weight * E, 0)
            weights += dr.select(is_valid, weight, 0)
        found = weights > 0
        return total * dr.select(found, dr.rcp(weights), 0), found

    def _bucket(self, p: mi.Point3f, level: mi.UInt32) -> mi.UInt32:
        width = self._width * mi.Float(mi.UInt32(1) << level)
        cell = mi.Vector3i(dr.floor(mi.Vector3f(p) / width))
        return _hash(mi.UInt32(cell.x), mi.UInt32(cell.y), mi.UInt32(cell.z), level) & self._mask

    def _weight(
        self, index: mi.UInt32, p: mi.Point3f, n: mi.Normal3f, level: mi.UInt32, active: mi.Bool
    ) -> mi.Float:
        """The weight of a record: 1 − ε/a where ε < a, so that the result is continuous where a
        record ceases to be valid. (Eq. 10.9 has 1/ε, which shows the noise of each record at its
        place.)"""
        row = index * (2 + 2 * self._channels)
        first = dr.gather(mi.Vector4f, self._records, row, active)
        second = dr.gather(mi.Vector4f, self._records, row + 1, active)
        way = mi.Vector3f(p.x - first.x, p.y - first.y, p.z - first.z)
        normal = mi.Vector3f(second.x, second.y, second.z)
        # Eq. 10.8, in units of a
        scale = dr.rcp(self._accuracy)
        change = (dr.norm(way) * first.w + dr.safe_sqrt(1 - dr.dot(n, normal))) * scale
        # Points behind a record see what it does not (Ward et al. 1988)
        to_radius = first.w * scale
        is_valid = dr.dot(way, n + normal) * 0.5 * to_radius > -_BEHIND
        is_valid &= dr.abs(dr.dot(way, normal)) * to_radius < _BESIDE
        # Cells of two levels may share a bucket
        is_valid &= active & (second.w == mi.Float(level))
        return dr.select(is_valid, dr.maximum(1 - change, 0), 0)

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
    records: Records, radius: np.ndarray, level: np.ndarray, width: float, buckets: int
) -> tuple[np.ndarray, np.ndarray]:
    """The first entry of each bucket, and the entries: the records, by bucket and by number."""
    count, p, n = len(records), records.p.astype(np.float64), records.n.astype(np.float64)
    widths = width * 2.0**level
    low = np.floor((p - radius[:, None]) / widths[:, None]).astype(np.int64)
    pairs = []
    for corner in np.ndindex(3, 3, 3):
        cell = low + corner
        way = (cell + 0.5) * widths[:, None] - p
        # Whether the cell touches the cube around the record, and the layer at its tangent plane
        touches = (np.abs(way) <= (radius + 0.5 * widths)[:, None]).all(axis=1)
        half = 0.505 * widths * np.abs(n).sum(axis=1)
        touches &= np.abs((way * n).sum(axis=1)) <= _BESIDE * radius + half
        index = np.flatnonzero(touches)
        x, y, z = cell[index].astype(np.uint32).T
        bucket = _hash(x, y, z, level[index].astype(np.uint32)) & np.uint32(buckets - 1)
        pairs.append(bucket.astype(np.int64) * count + index)
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
