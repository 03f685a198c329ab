"""The state of a render with chains, in a file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from . import learned_file

#: The only part of these files.
_PART = "chains"


class ChainFile:
    """A file from which a render goes on, and which it writes.

    Parameters:
        path: The file. It need not be there yet.
        scene, sensor, seed: What is rendered.
        parameters: Of the integrator, as far as the image depends on them.
        where: What errors call the parameter that names the file.
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

    def load(self) -> dict[str, np.ndarray] | None:
        """What was saved; ``None`` if there is no file.

        Raises:
            ValueError: It is no such file, has been damaged, or belongs to another render.
        """
        if not self._path.exists():
            return None
        return learned_file.load(self._path, self._scene, self._made_by, self._where)[_PART]

    def save(self, arrays: dict[str, np.ndarray]) -> None:
        """Writes the file, or replaces it."""
        learned_file.save(self._path, self._scene, self._made_by, {_PART: arrays})


def _digest(sensor: mi.Sensor) -> str:
    """Of the parameters that it has by name, of its class, and of its motion."""
    values = mi.traverse(sensor)
    motion = getattr(sensor, "motion", "")
    text = "".join(f"{key}={values[key]}" for key in sorted(values.keys()))
    return hashlib.sha256(f"{sensor.class_name()} {motion} {text}".encode()).hexdigest()[:16]
