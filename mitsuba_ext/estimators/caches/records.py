"""The records of an irradiance cache, and how far each of them is valid."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from ...util.stored_arrays import StoredArrays
from .hemisphere import Irradiance

#: Of how many neighbours a record's radius is clamped, and how often: a small radius spreads from
#: neighbour to neighbour.
_NEIGHBOURS, _ROUNDS = 12, 8

#: Two records disagree if they differ by more than the accuracy allows plus this number of standard
#: errors. A record then reaches this share of the way between them.
_NOISE, _SHORTER = 2.0, 0.7


#: The most records of a file, and how far from the origin they may lie and reach, in units of the
#: smallest reach: cells are numbered.
_MOST, _FARTHEST = 1 << 22, 2.0**40


@dataclass
class Places:
    """Places on surfaces; arrays of NumPy.

    Attributes:
        p: Position: [place, 3].
        n: Shading normal, on the side whose hemisphere counts.
        geometric: Geometric normal, on either side.
        footprint: The width of a camera pixel at the place: [place].
    """

    p: np.ndarray
    n: np.ndarray
    geometric: np.ndarray
    footprint: np.ndarray

    def __len__(self) -> int:
        return len(self.p)

    def __getitem__(self, index: np.ndarray | slice) -> Places:
        return Places(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass
class Records:
    """Irradiance at places: arrays of NumPy, with a row for each record.

    Attributes:
        p, n: Place and normal: [record, 3].
        irradiance: [record, channel].
        rotation, translation: Gradients, in world space: [record, channel, 3].
        reach: R of Eq. 10.8, the distance over which irradiance may change by its own size.
        least: The smallest value that ``reach`` may have, so that records are not dense.
        deviation: Standard error of the irradiance, in the brightest channel.
    """

    p: np.ndarray
    n: np.ndarray
    irradiance: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    reach: np.ndarray
    least: np.ndarray
    deviation: np.ndarray

    @classmethod
    def none(cls, channels: int) -> Records:
        """No records."""
        vector, tensor = np.zeros((0, 3), np.float32), np.zeros((0, channels, 3), np.float32)
        number = np.zeros(0, np.float32)
        colour = np.zeros((0, channels), np.float32)
        return cls(vector, vector, colour, tensor, tensor, number, number, number)

    def __len__(self) -> int:
        return len(self.p)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, for a file."""
        return dict(vars(self))

    @classmethod
    def of_arrays(cls, arrays: StoredArrays, channels: int) -> Records:
        """The records from :meth:`arrays`.

        Raises:
            DamagedError: The arrays are not records with this number of channels.
        """
        p = arrays.take("p", "f", (None, 3), longest=3 * _MOST)
        count, least = len(p), np.finfo(np.float32).tiny
        shapes = {
            "n": (count, 3), "irradiance": (count, channels), "rotation": (count, channels, 3),
            "translation": (count, channels, 3), "reach": (count,), "least": (count,),
            "deviation": (count,),
        }  # fmt: skip
        ranges = {"n": (-2, 2), "irradiance": (0, None), "reach": (least, None),
                  "least": (0, None), "deviation": (0, None)}  # fmt: skip
        others = {
            name: arrays.take(name, "f", shape, *ranges.get(name, (None, None)), 9 * _MOST)
            for name, shape in shapes.items()
        }
        if count:
            farthest = _FARTHEST * float(others["reach"].min())
            lengths = (np.abs(p), others["reach"], others["least"])
            is_near = all(float(length.max()) < farthest for length in lengths)
            arrays.require(is_near, "places and reaches are too far apart")
        return cls(p, **others)

    def joined(self, other: Records) -> Records:
        """These records and others."""
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return Records(*(np.concatenate(pair) for pair in pairs))

    def adapted(self, accuracy: float) -> Records:
        """The records, valid where their neighbours confirm it.

        - A record that predicts another one wrongly, by more than the accuracy and the noise of the
          two, is not valid there. Distances and gradients do not reveal edges.
        - No record reaches much farther than its neighbours: R_i ≤ R_j + |x_i − x_j|. Where one
          record has seen a small object nearby, others may have missed it.

        Source: J. Křivánek, K. Bouatouch, S. Pattanaik, J. Žára, *Making Radiance and Irradiance
        Caching Practical: Adaptive Caching and Neighbor Clamping*, EGSR 2006.

        Parameters:
            accuracy: a of Eq. 10.9.
        """
        count = min(_NEIGHBOURS + 1, len(self))
        if count < 2:
            return self
        distance, index = cKDTree(self.p).query(self.p, count)
        bound = np.where(self._is_wrong(index, accuracy), distance / accuracy, np.inf).min(axis=1)
        reach = np.maximum(np.minimum(self.reach, _SHORTER * bound), self.least)
        for _ in range(_ROUNDS):
            bound = (reach[index] + distance).min(axis=1)
            clamped = np.maximum(np.minimum(reach, bound), self.least)
            if np.array_equal(clamped, reach):
                break
            reach = clamped
        return replace(self, reach=reach.astype(np.float32))

    def _is_wrong(self, index: np.ndarray, accuracy: float) -> np.ndarray:
        """The neighbours that a record predicts wrongly, within its reach."""
        way = self.p[index] - self.p[:, None]
        turn = np.cross(self.n[:, None], self.n[index])
        predicted = self.irradiance[:, None] + np.einsum("rcx,rkx->rkc", self.translation, way)
        predicted += np.einsum("rcx,rkx->rkc", self.rotation, turn)
        found = self.irradiance[index]
        error = np.abs(np.maximum(predicted, 0) - found).max(axis=2)
        size = 0.5 * (self.irradiance[:, None] + found).max(axis=2)
        noise = self.deviation[:, None] + self.deviation[index]
        cosine = (self.n[:, None] * self.n[index]).sum(axis=2)
        change = np.linalg.norm(way, axis=2) / self.reach[:, None]
        change += np.sqrt(np.maximum(1 - cosine, 0))
        return (error > accuracy * size + _NOISE * noise) & (change < accuracy)


def made_of(
    places: Places, found: Irradiance, frames: np.ndarray, bounds: tuple[float, float]
) -> Records:
    """Records from what was gathered at places.

    Parameters:
        frames: Tangents and normal of each place: [place, 3 vectors, 3].
        bounds: The smallest and the largest reach, in widths of a pixel.
    """
    least, most = (places.footprint * bound for bound in bounds)
    translation = np.einsum("rcx,rxy->rcy", found.translation, frames)
    rotation = np.einsum("rcx,rxy->rcy", found.rotation, frames)
    # Noise lengthens gradients: what it may have made of nothing is left out
    slope = np.linalg.norm(translation, axis=2).max(axis=1)
    noise = np.minimum(found.slope_deviation / np.maximum(slope, 1e-30), 1)
    translation *= (1 - noise**2)[:, None, None]
    # Irradiance changes by its own size over the distance E / |∇E|
    changes = found.value.max(axis=1) / np.maximum(slope * (1 - noise), 1e-30)
    reach = np.minimum(found.distance, changes)
    # A record that is used farther than its gradient allows has a smaller gradient
    # (G. Ward Larson, R. Shakespeare, *Rendering with Radiance*, 1998)
    excess = np.minimum(1, changes / np.maximum(least, 1e-30))
    arrays = (
        places.p, places.n, found.value, rotation, translation * excess[:, None, None],
        np.clip(reach, least, most), least, found.deviation,
    )  # fmt: skip
    return Records(*(array.astype(np.float32) for array in arrays))
