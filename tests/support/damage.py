"""Damages files: bytes change as on bad disks, and values as if somebody meant harm."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsuba_ext.util import archives

#: Numbers that are no lanes, no lengths, no probabilities.
_ODD = (0, 1, -1, 2, 127, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, np.nan, np.inf, -np.inf,
        1e-40, 1e30, 3.4e38, 1e300)  # fmt: skip


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """A file with flipped bits, other bytes, a piece that is lost, doubled, or in another place."""
    data, size = bytearray(content), len(content)
    # The directory of an archive, at its end, has no checksum of its own
    begin = max(0, size - 1500) if rng.random() < 0.4 else 0
    place = int(rng.integers(begin, size))
    length = int(min(rng.integers(1, 1 + max(1, size // 4)), size - place))
    kind = rng.integers(7)
    if kind <= 1:
        data[place] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        data[place] = int(rng.integers(256))
    elif kind == 3:
        del data[place:]
    elif kind == 4:
        data[place : place + length] = bytes(length)
    elif kind == 5:
        del data[place : place + length]
    else:
        other = int(rng.integers(0, size))
        length = min(length, size - other)
        first, second = data[place : place + length], data[other : other + length]
        data[place : place + length], data[other : other + length] = second, first
    return bytes(data)


def contents(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an archive that this package wrote, without its form and its checksum."""
    archive = archives._Archive(file)
    return {key: archive.read(key) for key in archive.headers if key not in ("format", "digest")}


def form(file: Path) -> str:
    """What an archive holds."""
    return archives._Archive(file).form()


def edited(
    arrays: dict[str, np.ndarray], rng: np.random.Generator, fixed: tuple[str, ...] = ()
) -> dict[str, np.ndarray]:
    """Arrays of which one is missing, of another type or shape, or has other values.

    Parameters:
        fixed: Names of arrays that remain.
    """
    names = [name for name in arrays if name not in fixed]
    name = names[rng.integers(len(names))]
    array, kind = arrays[name], rng.integers(9)
    if kind == 0:
        return {key: x for key, x in arrays.items() if key != name}
    if kind == 1:
        other = arrays[names[rng.integers(len(names))]]
    elif kind == 2 and array.ndim:
        other = array[: int(rng.integers(len(array) + 1))]
    elif kind == 3:
        other = array[None] if rng.random() < 0.5 else array.ravel()
    elif kind == 4:
        kinds = (np.float64, np.int64, np.uint8, bool, ">u4", "U4", "c16", "M8[s]")
        with np.errstate(all="ignore"):
            other = np.zeros(array.shape, kinds[rng.integers(len(kinds))])
    elif array.dtype.kind not in "iufb":
        other = np.array("x" * int(rng.integers(100)))
    else:
        other = _other_values(array, rng)
    return {**arrays, name: other}


def _other_values(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    other = array.copy()
    flat = other.reshape(-1)
    if rng.random() < 0.3:
        values = np.frombuffer(rng.bytes(flat.nbytes), np.uint8)
        flat[...] = (values & 1 > 0) if array.dtype == bool else values.view(array.dtype)
        return other
    places = rng.integers(0, max(1, flat.size), 1 + int(rng.integers(3)) * flat.size // 4)
    with np.errstate(all="ignore"):
        odd = np.array(_ODD[rng.integers(len(_ODD))])
        flat[places[: flat.size]] = odd.astype(array.dtype, casting="unsafe")
    return other


def edits(file: Path, count: int, seed: int, fixed: tuple[str, ...] = ()) -> Iterator[None]:
    """Writes edited arrays to a file, with the checksums that belong to them."""
    rng, arrays, name = np.random.default_rng(seed), contents(file), form(file)
    for _ in range(count):
        archives.write(file, name, edited(arrays, rng, fixed))
        yield


def damages(file: Path, count: int, seed: int) -> Iterator[None]:
    """Writes damaged contents to a file."""
    rng, content = np.random.default_rng(seed), file.read_bytes()
    for _ in range(count):
        file.write_bytes(damaged(content, rng))
        yield
