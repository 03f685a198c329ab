"""The folder in which a render is saved."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..util import archives, marks
from ..util.errors import InputError
from ..util.files import make_folder, replacing
from ..util.stored_arrays import DamagedError
from .state import RenderState

#: The files: the description of the render, the state, and the previous state.
_DESCRIPTION, _STATE, _PREVIOUS_STATE = "render.json", "state.npz", "state.before.npz"

#: The key, in a description, of the hashes of the scene's files by name. They serve only to name
#: the file that has changed, because names can differ between machines.
_FILE_HASHES = "scene files"

#: The kind of a state file and the version of its format.
_FORMAT = "mitsuba_ext render 3"

#: The array of a state that holds the digest of the description, so that a state copied from
#: another folder is rejected.
_DESCRIPTION_DIGEST = "description"

#: The maximum size of a description, in bytes.
_MAX_BYTES = 1 << 26


class CheckpointFolder:
    """A folder with the state of a render, from which it can continue.

    A new state replaces the old one in one step, and the previous state is kept. Whenever and
    however the process ends, one of the two is undamaged.

    Parameters:
        path: The folder, which is made if it is missing.

    Attributes:
        damaged: The file of the newest state, if :meth:`load` found it damaged and returned the
            previous state; otherwise ``None``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged: Path | None = None

    def in_use(self):
        """A context in which no other process can use the folder."""
        make_folder(self.path)
        return marks.locked(self.path)

    def describe(self, description: Mapping[str, Any]) -> None:
        """Stores the description of the render, or compares it with the stored one.

        Raises:
            InputError: The folder belongs to another render.
        """
        file = self.path / _DESCRIPTION
        if not file.exists():
            if any((self.path / name).exists() for name in (_STATE, _PREVIOUS_STATE)):
                raise InputError(f"{file}: is missing: the folder can no longer be used")
            with replacing(file) as temporary:
                temporary.write_text(json.dumps(description, indent=1, default=str))
                _flush(temporary)
            return
        check_same(self.description(), json.loads(json.dumps(description, default=str)), self.path)

    def description(self) -> dict[str, Any]:
        """The stored description of the render.

        Raises:
            InputError: The description is missing or damaged.
        """
        file = self.path / _DESCRIPTION
        if not file.exists():
            raise InputError(f"{self.path}: has no {_DESCRIPTION}: no render is kept here")
        try:
            description = json.loads(archives.read_bytes(file, _MAX_BYTES))
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(f"{file}: cannot be read ({error})") from None
        if not isinstance(description, dict):
            raise InputError(f"{file}: is not a description of a render")
        return description

    def load(self, film: mi.Film | None = None) -> RenderState:
        """The newest undamaged state; an empty state if there is none.

        Args:
            film: The film that the images must fit and that is then filled; ``None`` for any.

        Raises:
            InputError: There are states, but all of them are damaged.
        """
        found = [self.path / name for name in (_STATE, _PREVIOUS_STATE)]
        found = [file for file in found if file.exists()]
        for file in found:
            try:
                arrays = archives.read(file, _FORMAT, f"{file}", "delete it")
                # States are not compressed, so they are no larger than their files
                state = RenderState.from_arrays(arrays, file.stat().st_size)
                if _DESCRIPTION_DIGEST in arrays:
                    of = arrays.text(_DESCRIPTION_DIGEST)
                    arrays.require(of == self._digest(), f"it is not a state of {_DESCRIPTION}")
            except (DamagedError, OSError):
                continue
            if film is not None and not state.fits(film):
                continue
            self.damaged = None if file == found[0] else found[0]
            return state
        if found:
            raise InputError(
                f"{found[0]}: is damaged, or was written by another version: delete {self.path}, "
                f"and begin again"
            )
        return RenderState()

    def save(self, state: RenderState) -> None:
        """Saves a state.

        Raises:
            OSError: The state cannot be written; the previous one still exists.
        """
        file = self.path / _STATE
        with replacing(file) as temporary:
            with temporary.open("wb") as stream:
                arrays = {**state.arrays(), _DESCRIPTION_DIGEST: np.array(self._digest())}
                archives.write_to(stream, _FORMAT, arrays, is_compressed=False)
                stream.flush()
                os.fsync(stream.fileno())
            # A damaged state must not replace the undamaged previous one
            if file.exists() and self.damaged is None:
                os.replace(file, self.path / _PREVIOUS_STATE)
        self.damaged = None

    def _digest(self) -> str:
        """The digest of the stored description; empty if there is none."""
        try:
            contents = archives.read_bytes(self.path / _DESCRIPTION, _MAX_BYTES)
        except OSError:
            return ""
        return hashlib.sha256(contents).hexdigest()


def check_same(
    before: Mapping[str, Any], now: Mapping[str, Any], where: object, free: Sequence[str] = ()
) -> None:
    """
    Args:
        before, now: Descriptions of renders.
        where: The name of ``before`` in error messages.
        free: Keys that may differ. The name of the scene's file may always differ.

    Raises:
        InputError: The descriptions differ; the message names the difference.
    """
    if found := difference(before, now, free):
        raise InputError(
            f"{where}: holds another render: {found}; use another folder, or make it the same again"
        )


def difference(before: Mapping[str, Any], now: Mapping[str, Any], free: Sequence[str] = ()) -> str:
    """A text about the first key in which two descriptions differ; empty if they agree."""
    for key in dict.fromkeys([*before, *now]):
        if key in ("scene", _FILE_HASHES, *free) or before.get(key) == now.get(key):
            continue
        there, here = before.get(key), now.get(key)
        change = f"{there} there, {here} here"
        if key == f"{_FILE_HASHES} hash":
            files = (d.get(_FILE_HASHES) for d in (before, now))
            files = (f if isinstance(f, Mapping) else {} for f in files)
            key, change = _FILE_HASHES, _changed_files(*files)
        elif key.endswith("hash"):  # the value would not help the user
            key = key.removesuffix("hash").strip()
            change = "its code has changed" if key == "integrator" else "it has changed"
        elif isinstance(there, Mapping) and isinstance(here, Mapping):
            inner = next(k for k in [*there, *here] if there.get(k) != here.get(k))
            change = f"{inner}: {there.get(inner)} there, {here.get(inner)} here"
        return f'"{key}" differs ({change})'
    return ""


def _changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """A text that names the files whose hashes differ."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    are = "has" if len(names) == 1 else "have"
    return f"{', '.join(names[:3])}{more} {are} changed" if names else "their order has changed"


def _flush(path: Path) -> None:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
