"""Files with everything that a render has learned."""

from __future__ import annotations

from collections.abc import Mapping
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

#: For each slot, the arrays from which the decision of the last stage is made.
States = dict[str, StoredArrays]


def save(
    path: Path, scene: mi.Scene, made_by: str, states: Mapping[str, Mapping[str, np.ndarray]]
) -> None:
    """Writes what was learned.

    Parameters:
        path: The file.
        scene: The scene for which it was learned.
        made_by: The parameters of the decisions that learned, and the size of the film.
        states: For each slot, the result of ``Learner.state``.

    Raises:
        OSError: It cannot be written.
    """
    arrays = {
        f"{slot}/{name}": array for slot, state in states.items() for name, array in state.items()
    }
    header = {"scene": np.array(fingerprint(scene)), "made_by": np.array(made_by)}
    archives.write(path, FORM, {**header, **arrays})


def check_target(path: Path) -> None:
    """Raises :class:`InputError` if :func:`save` cannot make or replace a file."""
    archives.check_target(path, FORM)


def load(path: Path, scene: mi.Scene, made_by: str, parameter: str) -> States:
    """Reads what :func:`save` has written. Parameters and errors: see :func:`read`."""
    arrays = read(path, scene, made_by, parameter)
    slots = {name.partition("/")[0] for name in arrays.names if "/" in name}
    return {slot: arrays.part(f"{slot}/") for slot in slots}


def read(path: Path, scene: mi.Scene, made_by: str, parameter: str) -> StoredArrays:
    """Reads what :func:`save` has written: arrays with the names ``slot/name``.

    Parameters:
        path, scene, made_by: As for :func:`save`.
        parameter: The name, in error messages, of the parameter that names the file.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is of another kind, damaged, or of another scene or other parameters.
            What was learned is checked when it is taken from the result.
    """
    if not path.exists():
        raise FileNotFoundError(
            f'{parameter} names "{path}", which does not exist: give it a file that "save_learned" '
            f"wrote"
        )
    origin, remedy = f'{parameter} names "{path}", which', "delete it, and begin again"
    arrays = archives.read(path, FORM, origin, remedy)
    if arrays.text("scene") != fingerprint(scene):
        raise ValueError(
            f"{origin} belongs to another scene, or this one has changed: {remedy}"
        )
    if (found := arrays.text("made_by", _LONGEST)) != made_by:
        raise ValueError(
            f"{origin} was made with other parameters: {found} instead of {made_by}"
        )
    return arrays
