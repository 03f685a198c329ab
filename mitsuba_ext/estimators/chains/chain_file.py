"""Saves the state of a render with Markov chains to a file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ...planning import learned_file
from ...util.stored_arrays import StoredArrays

#: The only section of these files.
_PART = "chains"


class ChainFile:
    """The file from which a render continues, and to which it saves its state.

    Parameters:
        path: The file, which need not exist yet.
        scene, sensor, seed: The scene, the sensor and the seed of the render.
        parameters: The integrator's parameters on which the image depends.
        where: The name in error messages of the parameter that names the file.
    """

    def __init__(
        self, path: Path, scene: mi.Scene, sensor: mi.Sensor, seed: int,
        parameters: dict[str, Any], where: str,
    ) -> None:  # fmt: skip
        self._path, self._scene, self._where = path, scene, where
        film = sensor.film()
        described = {
            **parameters, "seed": seed, "variant": mi.variant(), "size": film.crop_size(),
            "offset": film.crop_offset(), "filter": film.rfilter(), "sensor": _digest(sensor),
        }  # fmt: skip
        self._made_by = ", ".join(f"{k} = {' '.join(str(v).split())}" for k, v in described.items())

    def load(self) -> StoredArrays | None:
        """The saved state; ``None`` if the file does not exist.

        Raises:
            ValueError: The file is of another kind, damaged, or belongs to another render.
        """
        if not self._path.exists():
            return None
        arrays = learned_file.read(self._path, self._scene, self._made_by, self._where)
        return arrays.part(f"{_PART}/")

    def save(self, arrays: dict[str, np.ndarray]) -> None:
        """Writes or replaces the file."""
        learned_file.save(self._path, self._scene, self._made_by, {_PART: arrays})


def _digest(sensor: mi.Sensor) -> str:
    """A hash of the sensor's class, its motion, and its named parameters."""
    values = mi.traverse(sensor)
    motion = getattr(sensor, "motion", "")
    text = "".join(f"{key}={values[key]}" for key in sorted(values.keys()))
    return hashlib.sha256(f"{sensor.class_name()} {motion} {text}".encode()).hexdigest()[:16]
