"""The files that keep what a render has found for later renders of its scene: learned decisions,
records of irradiance, and the state of Markov chains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..scene.fingerprint import fingerprint
from ..util import archives
from ..util.stored_arrays import StoredArrays

#: What these files hold, and the version of their format.
FORM = "mitsuba_ext learned 3"

#: The most characters of the descriptions that files hold.
_LONGEST = 1 << 16


def check_target(path: Path) -> None:
    """Raises :class:`InputError` if :meth:`LearnedFile.save` cannot make or replace a file."""
    archives.check_target(path, FORM)


@dataclass(frozen=True)
class LearnedFile:
    """A file with one or several parts: the states of the slots that were learned, ``records``, or
    ``chains``. The file names the scene and the parameters for which it is valid.

    Attributes:
        path: The file, which need not exist.
        scene: The scene for which it is valid.
        made_by: The parameters on which its contents depend, as text. The text of another render
            must be the same.
        where: The beginning of error messages: the plugin, and its parameter that names the file.
    """

    path: Path
    scene: mi.Scene
    made_by: str
    where: str

    def save(self, parts: Mapping[str, Mapping[str, np.ndarray]]) -> None:
        """Writes or replaces the file.

        Parameters:
            parts: The arrays of each part.

        Raises:
            OSError: It cannot be written.
        """
        arrays = {
            f"{part}/{name}": array for part, x in parts.items() for name, array in x.items()
        }
        header = {"scene": np.array(fingerprint(self.scene)), "made_by": np.array(self.made_by)}
        archives.write(self.path, FORM, {**header, **arrays})

    def load(self) -> StoredArrays | None:
        """What :meth:`save` has written: arrays with the names ``part/name``. Their values are
        checked when they are taken. ``None`` if the file does not exist.

        Raises:
            ValueError: The file is of another kind, damaged, or of another scene or other
                parameters.
        """
        if not self.path.exists():
            return None
        origin, remedy = f'{self.where} names "{self.path}", which', "delete it, and begin again"
        arrays = archives.read(self.path, FORM, origin, remedy)
        if arrays.text("scene") != fingerprint(self.scene):
            raise ValueError(
                f"{origin} belongs to another scene, or this one has changed: {remedy}"
            )
        if (found := arrays.text("made_by", _LONGEST)) != self.made_by:
            raise ValueError(
                f"{origin} was made with other parameters: {found} instead of {self.made_by}"
            )
        return arrays
