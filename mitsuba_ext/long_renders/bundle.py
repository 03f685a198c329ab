"""A scene with all its files, for machines that do not have them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from ..errors import InputError
from ..inputs.content_hash import hash_each
from ..inputs.scene_files import named_by_absolute_path
from ..inputs.scenes import LoadedScene


@dataclass(frozen=True)
class Bundle:
    """Files, by their absolute paths on the machine that made the bundle.

    Attributes:
        files: Their contents.
        folders: Where Mitsuba searched for files there.
        digest: SHA-256 over all of it.
    """

    files: Mapping[str, bytes]
    folders: tuple[str, ...]
    digest: str

    @classmethod
    def of(cls, loaded: LoadedScene, others: tuple[str, ...] = ()) -> Bundle:
        """The files of a scene.

        Args:
            loaded: The scene.
            others: More files, such as that of an integrator.

        Raises:
            InputError: A file has changed since the scene was loaded, or it is named in a way that
                means nothing on other machines.
        """
        if fixed := named_by_absolute_path(loaded.files, loaded.parameters):
            raise InputError(
                f"{loaded.source}: the workers do not have its files, and these cannot be sent, "
                f'because "{fixed[0]}" is named by its absolute path: name it by a relative one'
            )
        try:
            files = {
                os.path.abspath(file): Path(file).read_bytes() for file in [*loaded.files, *others]
            }
            is_same = hash_each(loaded.files) == loaded.file_hashes
        except OSError as error:
            raise InputError(f"{loaded.source}: cannot be sent to the workers: {error}") from None
        if not is_same:
            raise InputError(f"{loaded.source}: its files have changed since the render began")
        # The scene may be a link; what the resolver does not find is opened in the current folder
        searched = [loaded.path.resolve().parent, *mi.file_resolver(), os.curdir]
        folders = tuple(os.path.abspath(str(folder)) for folder in searched)
        return cls(files, folders, _digest(files, folders))

    @contextlib.contextmanager
    def unpacked(self) -> Iterator[Callable[[str], str]]:
        """A context in which the files are in a temporary folder, and Mitsuba finds them. Yields a
        function that says where a file is now; names that are not in the bundle it returns.

        Raises:
            InputError: The bundle was damaged on its way, or there is no room for it.
        """
        if self.digest != _digest(self.files, self.folders):
            raise InputError("the scene was damaged on its way to the worker")
        with tempfile.TemporaryDirectory(prefix="mitsuba_ext_") as name:
            root = Path(name)

            def moved(path: str) -> str:
                inside = root / os.path.relpath(os.path.abspath(path), os.sep)
                return str(inside) if os.path.isabs(path) and inside.is_file() else path

            try:
                for path, content in self.files.items():
                    file = root / os.path.relpath(path, os.sep)
                    file.parent.mkdir(parents=True, exist_ok=True)
                    file.write_bytes(content)
            except OSError as error:
                raise InputError(f"the scene cannot be unpacked: {error}") from None
            resolver = mi.file_resolver()
            for folder in reversed(self.folders):
                resolver.prepend(str(root / os.path.relpath(folder, os.sep)))
            try:
                yield moved
            except InputError as error:  # names as the user knows them
                raise InputError(str(error).replace(str(root), "")) from error
            finally:
                for _ in self.folders:
                    del resolver[0]


def _digest(files: Mapping[str, bytes], folders: tuple[str, ...]) -> str:
    digest = hashlib.sha256(repr(folders).encode())
    for path in sorted(files):
        digest.update(f"{path} {len(files[path])} ".encode())
        digest.update(files[path])
    return digest.hexdigest()
