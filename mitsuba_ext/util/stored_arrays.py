"""Arrays from a file, checked as they are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, NoReturn

import numpy as np

#: The maximum size of a number, in bytes.
_MAX_BYTES = 8


class DamagedError(ValueError):
    """A file is damaged, or was not written by this package. The message is a sentence."""


class Header(NamedTuple):
    """The type and the shape of an array, known before its values are read."""

    dtype: np.dtype
    shape: tuple[int, ...]


class StoredArrays:
    """Arrays by name. :meth:`take` reads an array, and only if it has the expected type and shape,
    so a small file cannot fill the memory.

    Parameters:
        headers: The type and shape of each array.
        read: A function that returns the values of an array.
        origin: The beginning of error messages, which says where the arrays come from.
        remedy: The end of error messages, which says what the user can do.
    """

    def __init__(
        self, headers: Mapping[str, Header], read: Callable[[str], np.ndarray], origin: str,
        remedy: str,
    ) -> None:  # fmt: skip
        self._headers, self._read = headers, read
        self._origin, self._remedy = origin, remedy

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> StoredArrays:
        """Arrays that are already in memory."""
        headers = {name: Header(array.dtype, array.shape) for name, array in arrays.items()}
        return cls(headers, arrays.__getitem__, "what was learned", "learn it again")

    def __contains__(self, name: str) -> bool:
        return name in self._headers

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of an array that exists."""
        return self._headers[name].shape

    def part(self, prefix: str) -> StoredArrays:
        """The arrays whose names begin with ``prefix``, by the rest of their names."""
        headers = {k[len(prefix) :]: h for k, h in self._headers.items() if k.startswith(prefix)}
        return StoredArrays(
            headers, lambda name: self._read(prefix + name), self._origin, self._remedy
        )

    def parts(self) -> dict[str, StoredArrays]:
        """The arrays with names of the form ``part/name``, by the part and the rest of the name."""
        parts = {name.partition("/")[0] for name in self._headers if "/" in name}
        return {part: self.part(f"{part}/") for part in parts}

    def take(
        self,
        name: str,
        kinds: str,
        shape: tuple[int | None, ...] = (),
        least: float | None = None,
        most: float | None = None,
        longest: int = 1 << 24,
    ) -> np.ndarray:
        """Reads an array.

        Args:
            name: Its name.
            kinds: The accepted kinds of types (``numpy.dtype.kind``).
            shape: Its shape; ``None`` for an axis of any length.
            least, most: The range of its values. By default, real numbers are finite; infinite
                bounds allow infinite ones, and both of them NaN.
            longest: The maximum number of elements.

        Raises:
            DamagedError: There is no such array.
        """
        self.require(name in self._headers, f'without the array "{name}"')
        dtype, found = self._headers[name]
        self.require(
            dtype.kind in kinds and len(found) == len(shape) and dtype.isnative
            and (dtype.itemsize <= _MAX_BYTES or dtype.kind == "U"),
            f'the array "{name}" is of type {dtype} and shape {found}',
        )  # fmt: skip
        fits = all(there == wanted or wanted is None for there, wanted in zip(found, shape))
        size = int(np.prod(found, dtype=object))
        self.require(
            fits and size <= longest, f'the array "{name}" has the shape {_shape(found)}'
            + ("" if fits else f" instead of {_shape(shape)}"),
        )  # fmt: skip
        array = self._read(name)
        if dtype.kind in "iuf":
            self._check_range(name, array, least, most)
        return array

    def number(self, name: str, kinds: str, least: float, most: float) -> float | int:
        """Reads a single number, from ``least`` to ``most``."""
        return self.take(name, kinds, (), least, most).item()

    def text(self, name: str, longest: int = 1 << 16) -> str:
        """Reads a text of at most ``longest`` characters."""
        self._check_text(name, longest)
        return str(self.take(name, "U"))

    def texts(self, name: str) -> tuple[str, ...]:
        """Reads up to 4096 texts of up to 1024 characters each."""
        self._check_text(name, 1 << 10)
        return tuple(self.take(name, "U", (None,), longest=1 << 12).tolist())

    def require(self, condition: bool, fault: str) -> None:
        """
        Raises:
            DamagedError: The condition does not hold; the message names the fault.
        """
        if not condition:
            self.refuse(fault)

    def refuse(self, fault: str) -> NoReturn:
        """
        Raises:
            DamagedError: Always; the message names the fault.
        """
        raise DamagedError(f"{self._origin} has been damaged ({fault}): {self._remedy}")

    def _check_range(self, name, array, least, most) -> None:
        if array.dtype.kind == "f":
            # Values are used in single precision
            limit = float(np.finfo(np.float32).max)
            least, most = -limit if least is None else least, limit if most is None else most
            if np.isneginf(least) and np.isposinf(most):
                return
        # Negated, because comparisons with NaN are false
        if array.size and least is not None and not array.min() >= least:
            self.refuse(f'a value of "{name}" is {array.min():g}')
        if array.size and most is not None and not array.max() <= most:
            self.refuse(f'a value of "{name}" is {array.max():g}')

    def _check_text(self, name: str, longest: int) -> None:
        if name in self._headers:
            size = self._headers[name].dtype.itemsize // 4
            self.require(size <= longest, f'the text "{name}" has {size} characters')


def _shape(lengths: tuple[int | None, ...]) -> str:
    named = ["any" if length is None else str(length) for length in lengths]
    return f"({', '.join(named)}{',' if len(named) == 1 else ''})"
