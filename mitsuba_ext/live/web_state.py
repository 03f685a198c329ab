"""What the web page of a render shows."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .preview import half_floats, reduced
from .snapshot import Snapshot

#: The most points of a curve. If there are more, every other one is left out.
_MOST_POINTS = 400

#: The most images. If there are more, the oldest one is left out.
_MOST_PICTURES = 24

#: The time after which a page that no longer asks is taken for closed, in seconds.
_GONE = 3.0


@dataclass
class Picture:
    """An image on the page.

    Attributes:
        snapshot: The newest snapshot.
        number: Differs from one snapshot to the next.
        history: Seconds, samples per pixel and relMSE over time.
        size: Width and height of the image as sent.
        bad: The number of pixels that are NaN or infinite.
    """

    snapshot: Snapshot
    number: int
    history: list[tuple[float, int, float]] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)
    bad: int = 0
    _made: dict[str, tuple[int, bytes]] = field(default_factory=dict)

    def content(self, layer: str) -> bytes | None:
        """The pixels of a layer, ``image`` or ``error``; ``None`` if it is unknown. They are made
        when they are first asked for."""
        number, made = self._made.get(layer, (0, b""))
        if number != self.number:
            pixels = self.snapshot.rgb()
            if layer == "error":
                pixels = self.snapshot.relative_deviation()
            if pixels is None:
                return None
            made = half_floats(reduced(pixels))
            self._made[layer] = self.number, made
        return made


class WebState:
    """The state of the page, which several threads read and write.

    Attributes:
        spent: Called with the CPU time of images, in seconds.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.spent: Callable[[float], None] = lambda seconds: None
        self._pictures: dict[str, Picture] = {}
        self._facts: dict[str, str] = {}
        self._figures: dict[str, Any] = {}
        self._number = 0
        # By page: when it asked last, the number that it shows, and the phase that it knows
        self._pages: dict[str, tuple[float, int, str]] = {}

    def describe(self, facts: dict[str, str]) -> None:
        with self._lock:
            self._facts = dict(facts)

    def begin(self) -> None:
        with self._lock:
            self._figures = {}
            self._pictures.clear()

    def tell(self, figures: dict[str, Any]) -> None:
        with self._lock:
            self._figures.update((key, x) for key, x in figures.items() if x is not None)

    def receive(self, name: str, snapshot: Snapshot) -> None:
        size = reduced(snapshot.image[..., 0]).shape[::-1]
        bad = int((~np.isfinite(snapshot.rgb()).all(axis=2)).sum())
        with self._lock:
            self._number += 1
            picture = self._pictures.setdefault(name, Picture(snapshot, 0))
            picture.snapshot, picture.number = snapshot, self._number
            picture.size, picture.bad = size, bad
            if snapshot.error is not None and snapshot.error > 0:
                point = round(snapshot.seconds, 2), snapshot.spp, snapshot.error
                # A comparison renders the same numbers of samples again, with other seeds
                others = [old for old in picture.history if old[1] != snapshot.spp]
                picture.history = sorted([*others, point], key=lambda each: each[1])
            if len(picture.history) > _MOST_POINTS:
                del picture.history[1:-1:2]
            while len(self._pictures) > _MOST_PICTURES:
                del self._pictures[next(iter(self._pictures))]

    def as_dict(self, phase: str) -> dict[str, Any]:
        """The state without pixels, for JSON."""
        with self._lock:
            return {
                "phase": phase,
                "number": self._number,
                "facts": self._facts,
                "figures": {
                    key: x for key, x in self._figures.items()
                    if not isinstance(x, float) or math.isfinite(x)
                },
                "pictures": [_described(name, x) for name, x in self._pictures.items()],
            }  # fmt: skip

    def content(self, name: str, layer: str) -> tuple[int, bytes] | None:
        """The number and the pixels of an image; ``None`` if there is none."""
        with self._lock:
            picture = self._pictures.get(name)
            if picture is None:
                return None
            begin = time.thread_time()
            made = picture.content(layer)
            self.spent(time.thread_time() - begin)
            return None if made is None else (picture.number, made)

    def seen(self, page: str, number: int, phase: str) -> None:
        """A page says what it shows."""
        with self._lock:
            if page in self._pages or len(self._pages) < 64:
                self._pages[page] = time.monotonic(), number, phase

    def all_have_seen(self, phase: str) -> bool:
        """Whether all open pages show the newest image, and know the phase."""
        with self._lock:
            limit = time.monotonic() - _GONE
            return all(
                number >= self._number and known == phase
                for asked, number, known in self._pages.values() if asked > limit
            )


def _described(name: str, picture: Picture) -> dict[str, Any]:
    snapshot = picture.snapshot
    height, width = snapshot.image.shape[:2]
    error = snapshot.error
    return {
        "name": name, "number": picture.number, "size": picture.size, "film": (width, height),
        "spp": snapshot.spp, "bad": picture.bad, "history": picture.history,
        "error": error if error is not None and math.isfinite(error) else None,
        "measured": snapshot.is_error_measured, "has_error": snapshot.variance is not None,
        "learned": snapshot.learned, "effects": _rows(snapshot),
        "channels": [n for n in snapshot.channels if n not in ("R", "G", "B", "A")],
    }  # fmt: skip


def _rows(snapshot: Snapshot) -> list[tuple[str, str]]:
    """What was chosen for each decision, as text."""
    rows = []
    for decision, effect in snapshot.effects.items():
        parts = [f"{key} {effect[key]:.2f} ×" for key in ("variance", "time") if key in effect]
        kept = "kept" if effect.get("is_kept") else "not kept"
        rows.append((decision.replace("_", " "), ", ".join([kept, *parts])))
    return rows
