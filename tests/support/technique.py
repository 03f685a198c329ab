"""A technique that the tests render with, and the tests that it can get."""

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

#: Values of ``max_depth`` for the furnaces.
DEPTHS = (1, 2, 3, 6, -1)

#: The variants in which means are compared, besides ``llvm_ad_rgb``.
EVERY_VARIANT = ("llvm_ad_mono", "llvm_ad_spectral")


@dataclass(frozen=True)
class Checks:
    """The tests of a technique.

    Attributes:
        scenes: Scenes in which its mean is compared with the mean of ``path``.
        variants: Additional variants for the comparison of means, in one scene.
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
        nested: The nested integrator, of a plugin that draws the samples of another one. It gets
            ``max_depth`` and the parameters that a test sets.
        is_plugin: True if it represents its plugin. Then it also gets the tests of seeds, errors,
            gradients and AOVs.
        draws_like_path: True if, with the same seed, it draws the random numbers that ``path``
            draws. Then images are compared, which detects smaller errors than comparing means.
        makes_splats: True if one sample brings light to many pixels, or if pixels share photons.
            Then the errors of pixels depend on each other, and noise is estimated from many seeds.
        checks, thorough: Its tests: in each run, and in slow runs.
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
