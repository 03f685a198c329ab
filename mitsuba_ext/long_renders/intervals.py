"""How often a render is kept."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Interval:
    """How often a render is kept: every so many seconds, or samples per pixel."""

    seconds: float = 0.0
    spp: int = 0

    @classmethod
    def parse(cls, text: str) -> Interval:
        """Of text such as ``60s``, ``10m`` or ``100spp``.

        Raises:
            ValueError: It is none.
        """
        match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|spp)", text)
        if not match or float(match[1]) == 0 or (match[2] == "spp" and "." in match[1]):
            raise ValueError(f'expected something like 60s, 10m or 100spp, found "{text}"')
        if match[2] == "spp":
            return cls(spp=int(match[1]))
        return cls(seconds=float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2]])


class LastKept:
    """When a render was kept last.

    Parameters:
        spp: Its samples per pixel when it began.

    Attributes:
        begin: When that was.
    """

    def __init__(self, spp: int) -> None:
        self.begin = time.perf_counter()
        self.mark(spp)

    def mark(self, spp: int) -> None:
        """It is kept now."""
        self._time, self._spp = time.perf_counter(), spp

    def is_due(self, every: Interval, spp: int) -> bool:
        """Is it to be kept again?"""
        if every.spp:
            return spp - self._spp >= every.spp
        return time.perf_counter() - self._time >= every.seconds
