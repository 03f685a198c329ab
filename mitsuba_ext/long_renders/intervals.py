"""The intervals at which a render is saved."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Interval:
    """The interval at which a render is saved, in seconds or in samples per pixel."""

    seconds: float = 0.0
    spp: int = 0

    @classmethod
    def parse(cls, text: str) -> Interval:
        """Reads text such as ``60s``, ``10m`` or ``100spp``.

        Raises:
            ValueError: The text has the wrong form.
        """
        match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|spp)", text)
        if not match or float(match[1]) == 0 or (match[2] == "spp" and "." in match[1]):
            raise ValueError(f'expected something like 60s, 10m or 100spp, found "{text}"')
        if match[2] == "spp":
            return cls(spp=int(match[1]))
        return cls(seconds=float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]])


class LastKept:
    """Remembers when a render was last saved.

    Parameters:
        spp: The samples per pixel with which it begins.

    Attributes:
        begin: The time when it began, by ``time.perf_counter``.
    """

    def __init__(self, spp: int) -> None:
        self.begin = time.perf_counter()
        self.mark(spp)

    def mark(self, spp: int) -> None:
        """Records that the render was saved with ``spp`` samples per pixel."""
        self._time, self._spp = time.perf_counter(), spp

    def is_due(self, every: Interval, spp: int) -> bool:
        """Whether the render should be saved again."""
        if every.spp:
            return spp - self._spp >= every.spp
        return time.perf_counter() - self._time >= every.seconds
