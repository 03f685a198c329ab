"""Renders random scenes with all techniques and with ``path``, and looks for differences.

    python -m tests.support.fuzz --seconds 600 --seed 0

tests scenes 0, 1, 2 and so on, the kinds in turn, and prints for each failure the command that
repeats it with the same random numbers. ``--kind``, ``--scene`` and ``--technique`` select one of
each; ``--variant`` selects another variant. At the end it prints how often there was nothing to
compare, because ``path`` is no reference or the technique refuses the scene, and how often the
noise was too large for a comparison.
"""

from __future__ import annotations

import argparse
import gc
import math
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before drjit and mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip
from tests.support.random_kinds import KINDS  # isort: skip
from tests.support.random_scenes import SPP  # isort: skip
from tests.support.statistical import regions, sidak, z_welch  # isort: skip
from tests.support.techniques import REFERENCE, TECHNIQUES  # isort: skip

from mitsuba_ext.transport.frozen import forget_recordings  # isort: skip

#: Renders of each technique and of ``path``, and the factor by which there are more of them in the
#: second test of a suspicious difference.
_SEEDS, _REFERENCE_SEEDS, _MORE = 8, 16, 5

#: For kinds with several strata of time, whose images of ``path`` are averages over scenes: samples
#: per pixel of each render, and number of images.
_STRATUM_SPP, _STRATIFIED_SEEDS = SPP // 4, 8

#: z scores above which a difference is suspicious, and the number of comparisons over which the
#: probability of a false alarm is distributed.
_SUSPICIOUS, _COMPARISONS = 3.5, 100

#: Relative standard error of the means beyond which a comparison has too little power.
PRECISION = 0.05

#: Techniques that are tested: all but those with the most variance, whose means stay too uncertain,
#: one that cannot see mirrors and glass, and those that are biased.
TRIED = [
    name for name in TECHNIQUES
    if "paper" not in name and "floor" not in name
    and name not in ("light_tracer", "photon_map", "irradiance_cache", "vcm", "sppm")
]  # fmt: skip

#: Results of a comparison: right; ``path`` cannot be the reference, or the technique refuses what
#: it documents not to support; wrong.
OK, UNTOLD, FAILED = "ok", "could not tell", "failed"


@dataclass
class Verdict:
    """The result of the comparison of a technique with ``path`` in a scene.

    Attributes:
        status: One of ``OK``, ``UNTOLD`` and ``FAILED``.
        what: Why ``path`` cannot be the reference, or what is wrong.
        error: For ``OK``: the relative standard error of the difference of the means of the two
            images.
    """

    kind: str
    scene: int
    technique: str
    status: str = OK
    what: str = ""
    error: float = 0.0

    @property
    def is_noisy(self) -> bool:
        return self.status == OK and not self.error <= PRECISION

    def __str__(self) -> str:
        noise = f"means known to {self.error:.2%}" if self.status == OK else self.what
        return (
            f"python -m tests.support.fuzz --variant {mi.variant()} --kind {self.kind} --scene "
            f"{self.scene} --technique {self.technique}  # {self.status}: {noise}"
        )


class CannotTellError(Exception):
    """``path`` cannot be the reference; the message says why."""


class Trial:
    """One scene."""

    def __init__(self, kind: str, number: int, folder: Path) -> None:
        self.kind, self.number = kind, number
        self._kind, self._folder = KINDS[kind], folder
        rng = np.random.default_rng([number, 11])
        self._depth = {"max_depth": int(rng.choice([2, 3, 5])), "rr_depth": int(rng.choice([2, 5]))}
        self._depth |= self._kind.depth
        self._reference: dict[int, np.ndarray | CannotTellError] = {}

    def verdict(self, name: str) -> Verdict:
        """Compares the technique of this name."""
        try:
            status, what, error = self._judge(name)
        except CannotTellError as reason:
            status, what, error = UNTOLD, str(reason), 0.0
        return Verdict(self.kind, self.number, name, status, what, error)

    def _judge(self, name: str) -> tuple[str, str, float]:
        """The status, the fault, and the relative standard error."""
        reference = self._path(1)
        try:
            images = self.images(name, 1)
            # Single wavelengths are outside of the gamut
            is_negative = images.min() < 0 and not mi.is_spectral
            if is_negative or not np.isfinite(images).all():
                return FAILED, f"pixels from {images.min()} to {images.max()}", 0.0
            if images.shape[1:] != reference.shape[1:]:
                shapes = f"{images.shape[1:]} instead of {reference.shape[1:]}"
                return FAILED, f"images of shape {shapes}", 0.0
            z = self._score(images, reference)
            if z >= _SUSPICIOUS:
                reference, images = self._path(_MORE), self.images(name, _MORE)
                again = self._score(images, reference)
                if not again < sidak(_COMPARISONS * regions(images).shape[1]):
                    means = f"{images.mean():.5g} instead of {reference.mean():.5g}"
                    return FAILED, f"z = {z:.1f} and {again:.1f}, image means {means}", 0.0
        except CannotTellError:
            raise
        except Exception as error:  # any other error is a fault, because ``path`` has none here
            reason = _origin(error)
            if isinstance(reason, NotImplementedError):
                raise CannotTellError(f"refused: {_line(reason)}") from error
            return FAILED, _line(reason), 0.0
        if not (_colours(images).any() or _colours(reference).any()):
            raise CannotTellError("the image is black")
        return OK, "", _relative_error(images, reference)

    def _score(self, images: np.ndarray, reference: np.ndarray) -> float:
        """The largest |z| of means of the image and of its quarters."""
        ours, theirs = regions(images), regions(reference)
        mean = theirs.mean(axis=0)
        allowance = self._kind.allowance * np.abs(mean)
        return float(
            np.abs(z_welch(ours + np.clip(mean - ours.mean(axis=0), -allowance, allowance), theirs))
            .max()
        )  # fmt: skip

    # ---- Images: [seed, height, width, channel] ----

    def _path(self, times: int) -> np.ndarray:
        """``times`` the usual number of images of ``path``."""
        if times not in self._reference:
            try:
                self._reference[times] = self.images_of_path(times)
            except RuntimeError as error:
                self._reference[times] = CannotTellError(f"path: {_line(error)}")
        images = self._reference[times]
        if isinstance(images, CannotTellError):
            raise images
        if not np.isfinite(images).all():
            raise CannotTellError("pixels of path are not finite")
        return images

    def images_of_path(self, times: int) -> np.ndarray:
        count, strata = times * _REFERENCE_SEEDS, self._kind.strata
        integrator = replace(REFERENCE, plugin=self._kind.reference).make(**self._depth)
        rng = self._rng("path", times)
        if strata == 1:
            return self._render(0.0, integrator, _scattered(rng, count))
        count = times * _STRATIFIED_SEEDS
        seeds, jitter = _scattered(rng, count * strata), rng.random(count * strata)
        images = [
            self._render((k % strata + jitter[k]) / strata, integrator, [seed], _STRATUM_SPP)
            for k, seed in enumerate(seeds)
        ]
        return np.stack(images).reshape(count, strata, *images[0].shape[1:]).mean(axis=1)

    def images(self, name: str, times: int) -> np.ndarray:
        if TECHNIQUES[name].makes_splats and _has_beams(
            self._kind.make(self.number, self._folder, None)
        ):
            raise CannotTellError("path does not find beams")
        seeds = _scattered(self._rng(name, times), times * _SEEDS)
        return self._render(None, TECHNIQUES[name].make(**self._depth), seeds)

    def _rng(self, name: str, times: int) -> np.random.Generator:
        """The seeds, which are the same for one technique as for several."""
        return np.random.default_rng([self.number, times, zlib.crc32(name.encode())])

    def _render(
        self, at: float | None, integrator: mi.Integrator, seeds: list[int], spp: int = 0
    ) -> np.ndarray:
        # Objects of living scenes are compiled into the kernels of all others: delete each scene
        scene = mi.load_dict(self._kind.make(self.number, self._folder, at), optimize=False)
        images = np.array(
            [np.array(mi.render(scene, integrator=integrator, seed=s, spp=spp)) for s in seeds],
            dtype=np.float64,
        )
        return images if images.ndim == 4 else images[..., None]


def _has_beams(scene: Any) -> bool:
    if not isinstance(scene, dict):
        return False
    return scene.get("type") == "directionalarea" or any(map(_has_beams, scene.values()))


def _scattered(rng: np.random.Generator, count: int) -> list[int]:
    """Random seeds, because structured samplers draw the same numbers at neighbouring seeds."""
    return rng.choice(1 << 31, count, replace=False).tolist()


def _colours(images: np.ndarray) -> np.ndarray:
    """Without opacity, which may be the only channel with little noise."""
    return images[..., :3]


def _relative_error(images: np.ndarray, reference: np.ndarray) -> float:
    ours, theirs = (_colours(x).mean(axis=(1, 2, 3)) for x in (images, reference))
    error = math.sqrt(sum(x.var(ddof=1) / len(x) for x in (ours, theirs)))
    return error / max(abs(theirs.mean()), 1e-30)


def _origin(error: BaseException) -> BaseException:
    """The error that Dr.Jit's own, of a custom operation, hides."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def verdicts(kind: str, number: int, names: list[str]) -> Iterator[Verdict]:
    """Compares techniques in the scene of this kind and number."""
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(kind, number, Path(folder))
        for name in names:
            yield trial.verdict(name)
            # Scenes with plugins in Python may be garbage that waits for the collector
            gc.collect()


def some_techniques(number: int, count: int) -> list[str]:
    """The techniques that are tested on the scene of this number; they take turns."""
    return [TRIED[(count * number + i) % len(TRIED)] for i in range(count)]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60, help="how long (default: 60)")
    parser.add_argument("--seed", type=int, default=0, help="the first scene (default: 0)")
    parser.add_argument("--scene", type=int, help="only this scene")
    parser.add_argument("--kind", choices=KINDS, help="only this kind of scenes")
    parser.add_argument("--technique", choices=TECHNIQUES, help="only this technique")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    start = time.perf_counter()
    first = number = arguments.seed if arguments.scene is None else arguments.scene
    found: list[Verdict] = []
    while True:
        # With --scene, all kinds of this scene; else each scene has another kind
        kinds = list(KINDS) if arguments.scene is not None else [list(KINDS)[number % len(KINDS)]]
        names = [arguments.technique] if arguments.technique else some_techniques(number, 4)
        for kind in [arguments.kind] if arguments.kind else kinds:
            for verdict in verdicts(kind, number, names):
                found.append(verdict)
                # For a single scene, print all results
                if verdict.status != OK or verdict.is_noisy or arguments.scene is not None:
                    print(verdict, flush=True)
        number += 1
        if arguments.scene is not None or time.perf_counter() - start > arguments.seconds:
            break
        if number % 16 == 0:
            dr.sync_thread()
            forget_recordings()
            dr.flush_kernel_cache()
            dr.flush_malloc_cache()
    failed, untold = (sum(v.status == status for v in found) for status in (FAILED, UNTOLD))
    print(
        f"{number - first} scene(s), {len(found)} comparison(s): {failed} failure(s), {untold} "
        f"with nothing to compare, {sum(v.is_noisy for v in found)} with a relative standard "
        f"error above {PRECISION:.0%}"
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
