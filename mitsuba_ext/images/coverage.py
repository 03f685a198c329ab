"""The fraction of each pixel that each object and material covers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..util.errors import InputError
from ..util.stored_arrays import StoredArrays
from . import cryptomatte

#: The most characters of a list of names.
_MOST_TEXT = 1 << 28


@dataclass(frozen=True)
class Coverage:
    """The sums of the weights of samples, for each pixel, object and material.

    Attributes:
        size: Width and height of the image.
        objects, materials: The names; empty if they are not told apart.
        pixel: The index of the pixel, row by row. Entries are sorted by pixel and label.
        label: The number of the object, times one more than the number of materials, plus the
            number of the material. Numbers are positions in the lists of names, from 1 on; 0 stands
            for the background.
        weight: The sums of weights, as integers of any unit.
    """

    size: tuple[int, int]
    objects: tuple[str, ...]
    materials: tuple[str, ...]
    pixel: np.ndarray
    label: np.ndarray
    weight: np.ndarray

    def plus(self, other: Coverage) -> Coverage:
        """The coverage by the samples of both, which are of the same scene.

        Raises:
            InputError: Size or names differ.
        """
        if (self.size, self.objects, self.materials) != (
            other.size, other.objects, other.materials
        ):  # fmt: skip
            raise InputError("they have masks of different objects, or of different sizes")
        pixel, label, weight = (
            np.concatenate([getattr(self, key), getattr(other, key)])
            for key in ("pixel", "label", "weight")
        )
        order = np.lexsort((label, pixel))
        pixel, label, weight = _summed(pixel[order], label[order], weight[order])
        return Coverage(self.size, self.objects, self.materials, pixel, label, weight)

    def channels(self, masks: Sequence[tuple[str, str]]) -> dict[str, np.ndarray]:
        """The channels of masks, as arrays (height, width) of 32-bit numbers.

        Args:
            masks: Names and types, of :data:`mitsuba_ext.scene.aovs.MASK_TYPES`.
        """
        planes: dict[str, np.ndarray] = {}
        for name, kind in masks:
            if kind.startswith("cryptomatte_"):
                planes.update(self._mattes(name, kind.endswith("_object")))
            else:
                planes[f"{name}.I"] = self._largest(kind == "object_id")
        return planes

    def metadata(self, masks: Sequence[tuple[str, str]]) -> dict[str, str]:
        """The attributes of an EXR with :meth:`channels`: the manifests of Cryptomatte, and for
        numbers, the names in the order of these numbers, as JSON."""
        found: dict[str, str] = {}
        for name, kind in masks:
            names = self.objects if "object" in kind else self.materials
            if kind.startswith("cryptomatte_"):
                found.update(cryptomatte.metadata(name, names))
            else:
                found[f"{name}.names"] = json.dumps(names, ensure_ascii=False)
        return found

    # ---- As arrays ----

    def arrays(self) -> dict[str, np.ndarray]:
        """The coverage as arrays, for :meth:`from_arrays`."""
        names = {"objects": self.objects, "materials": self.materials}
        numbers = {key: getattr(self, key) for key in ("pixel", "label", "weight")}
        return {
            **{key: np.array(json.dumps(value)) for key, value in names.items()}, **numbers,
            "size": np.array(self.size),
        }  # fmt: skip

    @classmethod
    def from_arrays(cls, arrays: StoredArrays, most_bytes: int) -> Coverage:
        """The inverse of :meth:`arrays`.

        Raises:
            DamagedError: They are no coverage.
        """
        size = arrays.take("size", "iu", (2,), 1, 1 << 30)
        objects, materials = (_names(arrays, key) for key in ("objects", "materials"))
        labels = (len(objects) + 1) * (len(materials) + 1)
        pixel = arrays.take("pixel", "u", (None,), 0, int(np.prod(size)) - 1, most_bytes)
        label = arrays.take("label", "u", pixel.shape, 0, labels - 1, most_bytes)
        weight = arrays.take("weight", "i", pixel.shape, longest=most_bytes)
        return cls((int(size[0]), int(size[1])), objects, materials, pixel, label, weight)

    # ---- Helpers ----

    def _of(self, is_object: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, numbers of objects or of materials, and weights. The largest weight of a pixel
        comes first, and of equal ones the smallest number."""
        count = len(self.materials) + 1
        number = self.label // count if is_object else self.label % count
        order = np.lexsort((number, self.pixel))
        pixel, number, weight = _summed(self.pixel[order], number[order], self.weight[order])
        order = np.lexsort((number, -weight, pixel))
        return pixel[order], number[order], weight[order]

    def _mattes(self, layer: str, is_object: bool) -> dict[str, np.ndarray]:
        pixel, number, weight = self._of(is_object)
        total = np.zeros(self.size[0] * self.size[1], dtype=np.int64)
        np.add.at(total, pixel, weight)
        # Filters with negative lobes leave pixels without weight, and names with negative ones
        shown = (number > 0) & (weight > 0) & (total[pixel] > 0)
        pixel, number, weight = pixel[shown], number[shown], weight[shown]
        rank = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)
        names = self.objects if is_object else self.materials
        floats = np.array([0, *map(cryptomatte.name_as_float, names)], dtype=np.float32)
        pairs = np.zeros((cryptomatte.RANKS, 2, len(total)), dtype=np.float32)
        for each in range(cryptomatte.RANKS):
            here = rank == each
            pairs[each, 0, pixel[here]] = floats[number[here]]
            pairs[each, 1, pixel[here]] = weight[here] / total[pixel[here]]
        planes = pairs.reshape(-1, self.size[1], self.size[0])
        return dict(zip(cryptomatte.channel_names(layer), planes))

    def _largest(self, is_object: bool) -> np.ndarray:
        pixel, number, _weight = self._of(is_object)
        plane = np.zeros(self.size[0] * self.size[1], dtype=np.float32)
        first = np.searchsorted(pixel, pixel) == np.arange(len(pixel))
        plane[pixel[first]] = number[first]
        return plane.reshape(self.size[1], self.size[0])


def channel_names(masks: Sequence[tuple[str, str]]) -> list[str]:
    """The names of :meth:`Coverage.channels`."""
    names: list[str] = []
    for name, kind in masks:
        is_matte = kind.startswith("cryptomatte_")
        names += cryptomatte.channel_names(name) if is_matte else [f"{name}.I"]
    return names


def _summed(
    pixel: np.ndarray, label: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sorted entries; entries of the same pixel and label are summed."""
    if not len(pixel):
        return pixel, label, weight
    is_new = (np.diff(pixel) != 0) | (np.diff(label) != 0)
    first = np.flatnonzero(np.concatenate([[True], is_new]))
    return pixel[first], label[first], np.add.reduceat(weight, first)


def _names(arrays: StoredArrays, key: str) -> tuple[str, ...]:
    text = arrays.text(key, _MOST_TEXT)
    try:
        names = json.loads(text)
    except ValueError:
        names = None
    is_list = isinstance(names, list) and all(isinstance(name, str) for name in names)
    arrays.require(is_list, f'the names "{key}"')
    return tuple(names)
