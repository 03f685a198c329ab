"""Renders agree with stored references, within the noise of one render.

After an *intended* change: ``python -m tests.support.regenerate_references``, and look at the
difference.
"""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.support.regenerate_references import (
    CHANNELS,
    COMMAND,
    REFERENCES,
    REGRESSIONS,
    SEED_COUNT,
    TILE,
    Regression,
    render,
)
from tests.support.statistical import THRESHOLD, assert_images_are_sound, sidak, tiles

pytestmark = pytest.mark.usefixtures("variant")

#: Not one of those that made the references.
_SEED = 4711


def _read(regression: Regression) -> np.ndarray:
    if not regression.reference.exists():
        pytest.fail(f"{regression.reference} is missing: make it with `{COMMAND}`")
    bitmap = mi.Bitmap(str(regression.reference))
    fields = [bitmap.struct_()[i].name for i in range(bitmap.channel_count())]
    return np.array(bitmap)[..., [fields.index(name) for name in CHANNELS]].astype(np.float64)


def _z(deviation: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """z scores of single renders against a mean and a variance estimated from SEED_COUNT."""
    # The floor of the denominator: rounding in pixels without noise
    t = np.abs(deviation) / np.sqrt(variance * (1 + 1 / SEED_COUNT) + 1e-12)
    return stats.norm.isf(stats.t.sf(t, SEED_COUNT - 1))


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.slow) if regression.is_slow else name
    for name, regression in REGRESSIONS.items()
])  # fmt: skip
def test_render_agrees_with_its_reference(name: str) -> None:
    regression = REGRESSIONS[name]
    reference = _read(regression)
    images = render(regression, range(_SEED, _SEED + 1))
    # Colours of single wavelengths are outside of the gamut
    assert_images_are_sound(images, tolerance=9 if "spectral" in regression.variant else 0)
    mean, variance = reference[..., :3], reference[..., 3:6]
    assert images[0].shape == mean.shape

    whole = reference[0, 0, 7]
    assert math.sqrt(whole) < 0.03 * mean.mean(), "too noisy to say anything"
    z = _z(images.mean() - mean.mean(), whole)
    assert z < THRESHOLD, f"mean {images.mean():.5g} instead of {mean.mean():.5g}: z = {z:.2f}"

    # One value for each tile, from its first pixel
    tile_variance = reference[::TILE, ::TILE, 6].ravel()
    z = _z((tiles(images, TILE) - tiles(mean[None], TILE))[0], tile_variance)
    assert z.max() < sidak(z.size), f"tiles: z up to {z.max():.2f}"

    # Single pixels have heavy tails: nearly all of them agree
    z = _z(images[0] - mean, variance)
    assert (z < THRESHOLD).mean() > 0.98, f"{(z >= THRESHOLD).mean():.1%} of the values differ"


def test_no_reference_is_left_over() -> None:
    stored = {file.stem for file in REFERENCES.glob("*.exr")}
    assert stored <= set(REGRESSIONS), "delete what no test reads"


def test_missing_reference_fails_and_names_the_command() -> None:
    with pytest.raises(pytest.fail.Exception, match="regenerate_references"):
        _read(Regression("composed_path", "no_such_scene"))
