"""Renders random scenes with all techniques and with ``path``, and looks for differences.

    python tests/fuzz.py --seconds 600 --seed 0

tries scene 0, 1, 2 and so on, and prints for each failure the line that repeats it. ``--scene``
and ``--technique`` try one of each; ``--variant`` selects another variant.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before drjit and mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip
from random_scenes import random_scene  # isort: skip
from statistical import regions, sidak, z_welch  # isort: skip
from techniques import REFERENCE, TECHNIQUES, Technique  # isort: skip

#: Renders of ``path`` and of each of ours, and how many times as many decide about a suspicion.
_SEEDS, _REFERENCE_SEEDS, _MORE = 8, 16, 5

#: Scores that are suspicious, and how many comparisons share the probability of a false alarm.
_SUSPICIOUS, _COMPARISONS = 3.5, 100

#: What is tried: all techniques but those that gamble most, whose noise says nothing in a minute.
TRIED = [name for name in TECHNIQUES if "paper" not in name and "floor" not in name]


@dataclass
class Failure:
    """What went wrong, and how to see it again."""

    scene: int
    technique: str
    what: str

    def __str__(self) -> str:
        command = f"python tests/fuzz.py --variant {mi.variant()} --scene {self.scene}"
        return f"{command} --technique {self.technique}  # {self.what}"


class _Trial:
    """One scene."""

    def __init__(self, number: int, folder: Path) -> None:
        self.number = number
        rng = np.random.default_rng([number, 11])
        self._scene = mi.load_dict(random_scene(number, folder), optimize=False)
        self._depth = {"max_depth": int(rng.choice([2, 3, 5])), "rr_depth": int(rng.choice([2, 5]))}
        # Scattered: of structured samplers, neighbouring seeds share their numbers
        self._seeds = rng.choice(1 << 31, 4096, replace=False)
        self._taken = 0
        self._reference: dict[int, np.ndarray] = {}

    def failure(self, name: str) -> str | None:
        """What is wrong with a technique; ``None`` if nothing is, or if ``path`` cannot tell."""
        reference = self._path(_REFERENCE_SEEDS)
        if reference is None:
            return None
        try:
            images = self._render(TECHNIQUES[name], _SEEDS)
            # Single wavelengths are outside of the gamut
            is_negative = images.min() < 0 and not mi.is_spectral
            if is_negative or not np.isfinite(images).all():
                return f"pixels from {images.min()} to {images.max()}"
            if images.shape[1:] != reference.shape[1:]:
                return f"images of shape {images.shape[1:]} instead of {reference.shape[1:]}"
            z = _score(images, reference)
            if z < _SUSPICIOUS:
                return None
            reference = self._path(_MORE * _REFERENCE_SEEDS)
            images = self._render(TECHNIQUES[name], _MORE * _SEEDS)
        except Exception as error:  # whatever it is, ``path`` has none
            return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        again = _score(images, reference)
        if again < sidak(_COMPARISONS * regions(images).shape[1]):
            return None
        return (
            f"z = {z:.1f} and {again:.1f}, image means {images.mean():.5g} instead of "
            f"{reference.mean():.5g}"
        )

    def _path(self, seeds: int) -> np.ndarray | None:
        """Images of ``path``; ``None`` where it fails itself."""
        if seeds not in self._reference:
            try:
                self._reference[seeds] = self._render(REFERENCE, seeds)
            except RuntimeError:
                return None
        images = self._reference[seeds]
        return images if np.isfinite(images).all() else None

    def _render(self, technique: Technique, seeds: int) -> np.ndarray:
        integrator = technique.make(**self._depth)
        images = []
        for _ in range(seeds):
            seed = int(self._seeds[self._taken])
            self._taken += 1
            images.append(np.array(mi.render(self._scene, integrator=integrator, seed=seed)))
        images = np.array(images, dtype=np.float64)
        return images if images.ndim == 4 else images[..., None]


def _score(images: np.ndarray, reference: np.ndarray) -> float:
    """The largest |z| of means of the image and of its quarters."""
    return float(np.abs(z_welch(regions(images), regions(reference))).max())


def failures(number: int, names: list[str]) -> Iterator[Failure]:
    """What goes wrong with the scene of this number."""
    with tempfile.TemporaryDirectory() as folder:
        trial = _Trial(number, Path(folder))
        for name in names:
            what = trial.failure(name)
            if what is not None:
                yield Failure(number, name, what)
    # Scenes that are alive take part in the kernels of all others
    del trial
    gc.collect()


def some_techniques(number: int, count: int) -> list[str]:
    """Those that are tried on the scene of this number: all have their turn."""
    return [TRIED[(count * number + i) % len(TRIED)] for i in range(count)]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60, help="how long (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="the first scene (default: 0)")
    parser.add_argument("--scene", type=int, help="only this scene")
    parser.add_argument("--technique", choices=TECHNIQUES, help="only this technique")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    start, found, number = time.perf_counter(), 0, arguments.seed
    if arguments.scene is not None:
        number = arguments.scene
    while True:
        names = [arguments.technique] if arguments.technique else some_techniques(number, 4)
        for failure in failures(number, names):
            print(failure, flush=True)
            found += 1
        number += 1
        if arguments.scene is not None or time.perf_counter() - start > arguments.seconds:
            break
        if number % 16 == 0:
            dr.sync_thread()
            dr.flush_kernel_cache()
            dr.flush_malloc_cache()
    print(f"{number - (arguments.scene or arguments.seed)} scene(s), {found} failure(s)")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
