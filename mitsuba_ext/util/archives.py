"""Files of named arrays (``.npz``) with a checksum over their whole contents."""

from __future__ import annotations

import hashlib
import io
import math
import os
import stat
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from . import files
from .errors import InputError
from .files import replacing
from .stored_arrays import DamagedError, Header, StoredArrays

#: The arrays that :func:`write` adds.
_FORMAT, _DIGEST = "format", "digest"

#: The maximum number of arrays in a file, and the number of bytes read at once.
_MAX_ARRAYS, _CHUNK = 1 << 12, 1 << 20


def write(
    path: Path, form: str, arrays: Mapping[str, np.ndarray], is_compressed: bool = True
) -> None:
    """Writes or replaces a file.

    Args:
        form: The kind of contents and the version of their format.
        arrays: The arrays. The names ``format`` and ``digest`` are reserved.

    Raises:
        OSError: The file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        write_to(file, form, arrays, is_compressed)


def write_to(
    file: BinaryIO, form: str, arrays: Mapping[str, np.ndarray], is_compressed: bool = True
) -> None:
    """Like :func:`write`, to an open file."""
    arrays = {**arrays, _FORMAT: np.array(form)}
    arrays = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(_described(name, Header(array.dtype, array.shape)))
        digest.update(array.ravel().view(np.uint8).data)
    save = np.savez_compressed if is_compressed else np.savez
    save(file, **arrays, **{_DIGEST: np.array(digest.hexdigest())})


def read(path: Path, form: str, origin: str, remedy: str) -> StoredArrays:
    """Opens a file that :func:`write` has written, and checks its checksum. Until arrays are taken,
    it needs little more memory than the file.

    Args:
        path: The file, which exists.
        form: As for :func:`write`.
        origin: The beginning of error messages, such as ``"load_learned" names "x.npz", which``.
        remedy: The end of error messages, which says what the user can do.

    Raises:
        DamagedError: The file is of another kind or version, or damaged.
    """
    try:
        archive = _Archive(path)
        found = archive.form()
    except Exception:  # NumPy, zipfile and zlib raise a dozen kinds of exceptions
        raise DamagedError(f"{origin} is damaged, or of another kind: {remedy}") from None
    if found != form:
        of = "of another version" if found.split()[:-1] == form.split()[:-1] else f"a {found}"
        raise DamagedError(f"{origin} is {of}: {remedy}")
    try:
        is_sound = archive.is_sound()
    except Exception:
        is_sound = False
    arrays = StoredArrays(archive.headers, archive.read, origin, remedy)
    arrays.require(is_sound, "its checksum is wrong")
    return arrays


def check_target(path: Path, form: str) -> None:
    """Checks, before a render, that :func:`write` can make or replace a file. A scene names its
    files, and must not replace the user's other files.

    Raises:
        InputError: The file cannot be written, or a file of another kind exists.
    """
    files.check_target(path)
    if not os.path.lexists(path):
        return
    try:
        found = _Archive(path).form()
    except Exception:
        found = ""
    if found.split()[:-1] != form.split()[:-1]:
        raise InputError(
            f"{path}: is another file, which is not replaced: delete it, or name another one"
        )


class _Archive:
    """An open archive; the headers of all its arrays have been read.

    Attributes:
        headers: The type and the shape of each array.
    """

    def __init__(self, path: Path) -> None:
        self._zip = zipfile.ZipFile(io.BytesIO(read_bytes(path)))
        members = self._zip.infolist()
        names = [member.filename for member in members]
        if len(names) > _MAX_ARRAYS or len(set(names)) < len(names):
            raise ValueError("no archive of arrays")
        self._members = {m.filename.removesuffix(".npy"): m for m in members}
        self.headers = {name: self._opened(name)[1] for name in self._members}

    def form(self) -> str:
        header = self.headers[_FORMAT]
        if header.dtype.kind != "U" or header.shape or header.dtype.itemsize > 4 * 64:
            raise ValueError("no text")
        return str(self.read(_FORMAT))

    def is_sound(self) -> bool:
        """Whether the checksum is right."""
        digest = hashlib.sha256()
        for name in sorted(set(self.headers) - {_DIGEST}):
            header = self.headers[name]
            digest.update(_described(name, header))
            for chunk in self._chunks(name):
                digest.update(chunk)
        return self.headers[_DIGEST].dtype.kind == "U" and self.headers[_DIGEST].shape == () and (
            self.headers[_DIGEST].dtype.itemsize == 4 * 64
            and str(self.read(_DIGEST)) == digest.hexdigest()
        )

    def read(self, name: str) -> np.ndarray:
        header = self.headers[name]
        if 0 in header.shape:
            return np.empty(header.shape, header.dtype)
        values = bytearray().join(self._chunks(name))
        return np.frombuffer(values, header.dtype).reshape(header.shape)

    def _chunks(self, name: str) -> Iterator[bytes]:
        """The values of an array; their number must agree with its header."""
        stream, header = self._opened(name)
        left = math.prod(header.shape) * header.dtype.itemsize
        while left > 0:
            chunk = stream.read(min(left, _CHUNK))
            if not chunk:
                raise ValueError("the array ends too early")
            left -= len(chunk)
            yield chunk
        if stream.read(1):  # the end, where zipfile compares its own checksum
            raise ValueError("the array is longer than its header says")

    def _opened(self, name: str) -> tuple[BinaryIO, Header]:
        """A stream of an array's values, and its header."""
        stream = self._zip.open(self._members[name])
        if np.lib.format.read_magic(stream) != (1, 0):
            raise ValueError("another version of NumPy's format")
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        is_plain = not (dtype.hasobject or dtype.fields or is_fortran) and dtype.itemsize > 0
        if not is_plain or any(length < 0 for length in shape):
            raise ValueError("no plain array")
        return stream, Header(dtype, shape)


def read_bytes(path: Path, most: int | None = None) -> bytes:
    """The contents of a regular file. (Reading from a pipe would block until its writer writes.)

    Args:
        most: The maximum number of bytes; ``None`` for no limit.

    Raises:
        OSError: The file cannot be read, is not a regular file, or is too large.
    """
    with open(path, "rb", opener=_open_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError("it is not a regular file")
        if most is not None and status.st_size > most:
            raise OSError(f"it has {status.st_size} bytes, more than {most}")
        return file.read()


def _open_at_once(path: str, flags: int) -> int:
    """Opens a file; does not wait for the writer of a pipe."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _described(name: str, header: Header) -> bytes:
    return f"{name} {header.dtype} {header.shape}".encode()
