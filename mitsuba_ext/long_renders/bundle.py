"""A scene with all its files, for machines without them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from ..inputs.content_hash import hash_each
from ..inputs.scene_files import named_by_absolute_path
from ..inputs.scenes import LoadedScene
from ..util.errors import InputError


@dataclass(frozen=True)
class Bundle:
    """The contents of files.

    Attributes:
        files: The contents of the files, by their absolute paths on the machine that made the
            bundle.
        folders: The folders in which Mitsuba searched for files on that machine.
        digest: SHA-256 over paths, contents and folders.
    """

    files: Mapping[str, bytes]
    folders: tuple[str, ...]
    digest: str

    @classmethod
    def of(cls, loaded: LoadedScene, others: tuple[str, ...] = ()) -> Bundle:
        """Bundles the files of a scene.

        Args:
            loaded: The scene.
            others: More files, such as an integrator's.

        Raises:
            InputError: A file has changed since the scene was loaded, or the scene names it by an
                absolute path, which cannot be used on other machines.
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
        # The scene may be a link. Mitsuba searches the current folder last
        searched = [loaded.path.resolve().parent, *mi.file_resolver(), os.curdir]
        folders = tuple(os.path.abspath(str(folder)) for folder in searched)
        return cls(files, folders, _digest(files, folders))

    @contextlib.contextmanager
    def unpacked(self) -> Iterator[Callable[[str], str]]:
        """A context in which the files are in a temporary folder, where Mitsuba finds them. Yields
        a function that maps the path of a file to its path there; it returns other names unchanged.

        Raises:
            InputError: The bundle was damaged in transfer, or the disk has no room for it.
        """
        if self.digest != _digest(self.files, self.folders):
            raise InputError("the scene was damaged in transfer to the worker")
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
            except InputError as error:  # show the original paths instead of the temporary folder
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
