"""A few of the random scenes that ``python -m tests.support.fuzz`` tries by the hundred."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from tests.support.fuzz import FAILED, OK, TRIED, UNTOLD, Trial, Verdict, verdicts

pytestmark = pytest.mark.usefixtures("variant")

#: Variant, kind, and numbers of scenes. None of the moving scenes holds a ``roughplastic``, which
#: takes 70 ms at each load.
SCENES = [
    ("llvm_ad_rgb", "plain", (2, 3, 5)),
    ("llvm_ad_rgb", "moving", (1, 34, 46)),
    ("llvm_ad_rgb", "moving_camera", (4,)),
    ("llvm_ad_rgb", "constant_index", (7, 8)),
    ("llvm_ad_spectral", "constant_index", (51,)),
    ("llvm_ad_spectral", "furnace", (10, 11, 12, 13)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "kind", "scenes"), SCENES, indirect=["variant"])
def test_random_scenes_agree_with_path(variant: str, kind: str, scenes: tuple[int, ...]) -> None:
    """The noise of the comparisons is small enough, too."""
    mi.set_log_level(mi.LogLevel.Error)
    found = [verdict for n in scenes for verdict in verdicts(kind, n, _names(n))]
    told = "\n" + "\n".join(map(str, found))
    print(told)
    assert not [v for v in found if v.status == FAILED], told
    few = len(found) // 4
    assert sum(v.status == UNTOLD for v in found) <= few, f"path often cannot tell:{told}"
    assert sum(v.is_noisy for v in found) <= few, f"too noisy to say anything:{told}"


def _names(scene: int) -> list[str]:
    """Each scene tests the simplest technique and some of the others, which take turns."""
    numbers = [n for *_, scenes in SCENES for n in scenes]
    return list(dict.fromkeys(["composed_path", *TRIED[numbers.index(scene) :: len(numbers)]]))


# ---- The fuzzer's verdict on images ----


def _images(mean: float, noise: float, opacity: bool = False) -> Callable[..., np.ndarray]:
    """Independent images of 9 × 8 pixels, whose means scatter by ``noise``."""
    rng = np.random.default_rng(1 + int(1e3 * np.nan_to_num(mean)))

    def make(*_: object) -> np.ndarray:
        images = mean * np.abs(1 + noise * rng.normal(size=(8, 1, 1, 1))) * np.ones((8, 9, 8, 3))
        return np.pad(images, [(0, 0)] * 3 + [(0, int(opacity))], constant_values=1)

    return make


def _raise(*_: object) -> np.ndarray:
    raise RuntimeError("this scene is too much")


@pytest.mark.parametrize(
    ("path", "ours", "status", "what", "is_noisy"),
    [
        (_images(1, 0.01), _images(1.001, 0.01), OK, "", False),
        (_images(1, 0.01), _images(1.2, 0.01), FAILED, "z = ", False),
        (_images(1, 0.01), _images(1.001, 0.5), OK, "", True),
        (_images(1, 0.5, opacity=True), _images(1.001, 0.5, opacity=True), OK, "", True),
        (_images(1, 0.01), _images(np.nan, 0), FAILED, "nan", False),
        (_images(1, 0.01), _images(1, 0.01, opacity=True), FAILED, "shape", False),
        (_images(1, 0.01), _raise, FAILED, "this scene is too much", False),
        (_images(0, 0), _images(1, 0.01), FAILED, "z = ", False),
        (_images(0, 0), _images(0, 0), UNTOLD, "black", False),
        (_images(np.nan, 0), _images(1, 0.01), UNTOLD, "not finite", False),
        (_raise, _images(1, 0.01), UNTOLD, "this scene is too much", False),
    ],
    ids=["right", "biased", "noisy", "noisy_but_opaque", "nan", "channels", "raises", "not_black",
         "black", "nan_of_path", "path_raises"],
)  # fmt: skip
def test_verdict(monkeypatch, tmp_path: Path, path, ours, status, what, is_noisy) -> None:
    monkeypatch.setattr(Trial, "images_of_path", path)
    monkeypatch.setattr(Trial, "images", ours)
    verdict = Trial("plain", 0, tmp_path).verdict("neepp")
    assert (verdict.status, verdict.is_noisy) == (status, is_noisy), verdict
    assert what in verdict.what


def test_verdict_says_how_to_repeat_it() -> None:
    command, _, what = str(Verdict("moving", 7, "neepp", FAILED, "z = 9")).partition("  # ")
    assert command == (
        "python -m tests.support.fuzz --variant llvm_ad_rgb --kind moving --scene 7 "
        "--technique neepp"
    )
    assert what == "failed: z = 9"
