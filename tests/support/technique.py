"""What a technique of the tests is, and which tests it can get."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi

#: The scenes of the z-tests: max_depth, and samples per pixel of a render. Heavy tails (a small sun
#: through glass, caustics) are tested with short paths.
SCENES: dict[str, tuple[int, int]] = {
    "cornell_box": (6, 512),
    "door_ajar": (6, 512),
    "rooms": (4, 512),
    "mirrors_and_glass": (3, 512),
    "sunny_gloss": (2, 512),
    "window": (3, 256),
}

FURNACES = (
    "furnace_box", "furnace_convex", "furnace_glass", "furnace_isothermal", "furnace_lamps",
)  # fmt: skip

DEPTHS = (1, 2, 3, 6, -1)


@dataclass(frozen=True)
class Checks:
    """The tests of a technique.

    Attributes:
        scenes: Scenes in which its mean is compared with that of ``path``.
        variants: Additional variants for this.
        furnaces, depths: Furnaces with an exact answer, and values of ``max_depth``.
        cases: Hard cases.
    """

    scenes: Iterable[str] = ()
    variants: Iterable[str] = ()
    furnaces: Iterable[str] = ()
    depths: Iterable[int] = ()
    cases: Iterable[str] = ()

    def combinations(self, columns: Iterable[str]) -> list[tuple]:
        """All combinations of the values of some attributes."""
        return list(itertools.product(*(getattr(self, column) for column in columns)))


@dataclass(frozen=True)
class Technique:
    """A way to render.

    Attributes:
        plugin: The name of the integrator.
        parameters: Its parameters besides ``max_depth``.
        nested: The integrator whose samples it draws, where it draws those of another one; that one
            gets ``max_depth`` and what a test says.
        is_plugin: Does it represent its plugin? Then it also gets the tests of seeds, errors,
            gradients and AOVs.
        draws_like_path: At the same seed, does it draw the same numbers as ``path``? Then images
            are compared, which has more power than comparing means.
        makes_splats: Does one sample bring light to many pixels, or do pixels share photons? Then
            the errors of pixels depend on each other, and noise is estimated from many seeds.
        checks, thorough: Its tests.
    """

    plugin: str
    parameters: dict[str, Any] = field(default_factory=dict)
    nested: str = ""
    is_plugin: bool = False
    draws_like_path: bool = False
    makes_splats: bool = False
    checks: Checks = Checks()
    thorough: Checks = Checks()

    def make(self, max_depth: int = -1, **parameters: Any) -> mi.Integrator:
        """The integrator; it replaces the scene's own in ``mi.render``."""
        parameters = {"max_depth": max_depth, **parameters}
        if self.nested:
            parameters = {"nested": {"type": self.nested, **parameters}}
        return mi.load_dict({"type": self.plugin, **self.parameters, **parameters})
