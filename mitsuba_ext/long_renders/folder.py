"""The folder in which a render is kept."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import marks
from ..errors import InputError
from ..files import make_folder, replacing
from .state import RenderState

#: What is rendered; the state; the one before it.
_DESCRIPTION, _STATE, _BEFORE = "render.json", "state.npz", "state.before.npz"

#: The key of a description under which it has the hashes of the scene's files by their names. They
#: only tell which file has changed: the names differ from place to place.
_FILES = "scene files"

#: Number of the format of these files.
_FORMAT = 2


class CheckpointFolder:
    """A folder with the state of a render, from which it can go on.

    A new state replaces the old one in one step, and the one before stays: whatever ends the
    process, and at any moment, one of both is whole.

    Parameters:
        path: The folder, which is made if it is missing.

    Attributes:
        damaged: The file of the newest state, if :meth:`load` found that one damaged and returned
            the one before.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damaged: Path | None = None

    def in_use(self):
        """A context in which no other process can use the folder."""
        make_folder(self.path)
        return marks.in_use(self.path)

    def describe(self, description: Mapping[str, Any]) -> None:
        """Says what is rendered.

        Raises:
            InputError: Something else was rendered before in this folder.
        """
        file = self.path / _DESCRIPTION
        if not file.exists():
            if any((self.path / name).exists() for name in (_STATE, _BEFORE)):
                raise InputError(f"{file}: is missing: the folder cannot be used any more")
            with replacing(file) as temporary:
                temporary.write_text(json.dumps(description, indent=1, default=str))
                _flush(temporary)
            return
        check_same(self.description(), json.loads(json.dumps(description, default=str)), self.path)

    def description(self) -> dict[str, Any]:
        """What is rendered.

        Raises:
            InputError: This is no such folder, or it is damaged.
        """
        file = self.path / _DESCRIPTION
        if not file.exists():
            raise InputError(f"{self.path}: has no {_DESCRIPTION}: no render is kept here")
        try:
            return json.loads(file.read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: cannot be read ({error})") from None

    def load(self) -> RenderState:
        """The newest state that is whole; an empty one if there is none.

        Raises:
            InputError: There are states, but all of them are damaged.
        """
        found = [self.path / name for name in (_STATE, _BEFORE)]
        found = [file for file in found if file.exists()]
        for file in found:
            arrays = _read(file)
            if arrays is not None:
                self.damaged = None if file == found[0] else found[0]
                return RenderState.from_arrays(arrays)
        if found:
            raise InputError(f"{found[0]}: is damaged: delete {self.path}, and begin again")
        return RenderState()

    def save(self, state: RenderState) -> None:
        """Keeps a state.

        Raises:
            OSError: It cannot be written; the one before is still there.
        """
        file = self.path / _STATE
        temporary = self.path / f".{_STATE}"
        try:
            with temporary.open("wb") as stream:
                np.savez(stream, format=np.array(_FORMAT), **state.arrays())
                stream.flush()
                os.fsync(stream.fileno())
            # A damaged state must not replace the one before, which is whole
            if file.exists() and self.damaged is None:
                os.replace(file, self.path / _BEFORE)
            os.replace(temporary, file)
            self.damaged = None
        finally:
            temporary.unlink(missing_ok=True)


def check_same(
    before: Mapping[str, Any], now: Mapping[str, Any], where: object, free: Sequence[str] = ()
) -> None:
    """
    Args:
        before, now: Descriptions of renders.
        where: What the error calls the first.
        free: Keys that may differ. The name of the scene's file may always.

    Raises:
        InputError: They are not the same; the sentence names what differs.
    """
    if found := difference(before, now, free):
        raise InputError(
            f"{where}: holds another render: {found}; use another folder, or make it the same again"
        )


def difference(before: Mapping[str, Any], now: Mapping[str, Any], free: Sequence[str] = ()) -> str:
    """Says in which key two descriptions of renders differ; empty if they are the same."""
    for key in dict.fromkeys([*before, *now]):
        if key in ("scene", _FILES, *free) or before.get(key) == now.get(key):
            continue
        there, here = before.get(key), now.get(key)
        change = f"{there} there, {here} here"
        if key == f"{_FILES} hash":
            key, change = _FILES, _changed_files(before.get(_FILES, {}), now.get(_FILES, {}))
        elif key.endswith("hash"):  # which tells nobody anything
            key = key.removesuffix("hash").strip()
            change = "its code has changed" if key == "integrator" else "it has changed"
        elif isinstance(there, Mapping) and isinstance(here, Mapping):
            inner = next(k for k in [*there, *here] if there.get(k) != here.get(k))
            change = f"{inner}: {there.get(inner)} there, {here.get(inner)} here"
        return f'"{key}" differs ({change})'
    return ""


def _changed_files(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Names the files, of which hashes are given, that are not the same."""
    names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    are = "has" if len(names) == 1 else "have"
    return f"{', '.join(names[:3])}{more} {are} changed" if names else "their order has changed"


def _read(file: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a file; ``None`` if it is damaged."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return arrays if int(arrays.pop("format")) == _FORMAT else None
    except Exception:  # NumPy, zipfile and zlib raise a dozen kinds; a checksum is in the file
        return None


def _flush(path: Path) -> None:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
