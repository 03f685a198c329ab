"""Noise filters of chains: the visits that they drop, and the pixels that they even out."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from mitsuba_ext.estimators.chains.bootstrap import Bootstrap
from mitsuba_ext.estimators.chains.chains import ChainRules
from mitsuba_ext.estimators.chains.noise_filters import FilteredChains, FilteredImage, NoiseFilters
from mitsuba_ext.estimators.chains.small_steps import SmallSteps
from mitsuba_ext.estimators.chains.target import Contribution
from tests.support.chain_integrators import GLASS_BALL, erpt
from tests.support.chain_targets import Histogram, Target, found_at
from tests.support.stage import film, sensor, stage
from tests.support.statistical import assert_images_are_sound, batches

pytestmark = pytest.mark.usefixtures("variant")

# ---- Consecutive visits ----


class _Image(Histogram):
    """Counts proposals too."""

    def __init__(self) -> None:
        super().__init__()
        self.proposals = dr.zeros(mi.UInt32, 1)

    def _bin(self, found: Contribution) -> mi.UInt32:
        return mi.UInt32(0)

    def propose(self, found: Contribution) -> None:
        dr.scatter_add(self.proposals, mi.UInt32(1), mi.UInt32(0), found.target >= 0)

    def tensors(self) -> list[Any]:
        return [*super().tensors(), self.proposals]


def _visits(pixels: float, most: int, steps: int = 40, count: int = 512) -> tuple[float, int]:
    """Visits that chains add to the image, and their proposals. The film is ``pixels`` wide,
    and as high."""

    def hill(numbers: Any) -> Any:
        x, y = numbers.next_2d()
        return found_at(x * pixels, y * pixels, 0.1 + dr.exp(-20 * (x - 0.4) ** 2))

    target, image = Target(hill), _Image()
    samples = Bootstrap(target, 3, 1024)
    rules = ChainRules(0.0, SmallSteps(1 / 64, 1 / 4), 0.0)
    filters = NoiseFilters(most_consecutive=most)
    chains = FilteredChains(filters, target, image, rules, samples, samples.choose(count), 3)
    for _ in range(2):
        chains.advance(steps // 2)
    chains.end()
    return float(image.total.numpy()[0]) / count, int(image.proposals.numpy()[0]) // count


@pytest.mark.parametrize("most", [1, 7, 39])
def test_a_chain_that_never_leaves_a_pixel_adds_no_more_visits_than_the_limit(most: int) -> None:
    assert _visits(1.0, most) == (pytest.approx(most, rel=1e-5), 40)


def test_a_chain_that_never_stays_in_a_pixel_loses_no_more_than_rejected_mutations() -> None:
    """A state waits in its pixel for a mutation that is accepted."""
    all_of_them, _ = _visits(1e6, 0)
    assert all_of_them == pytest.approx(40, rel=1e-5)
    assert _visits(1e6, 40)[0] == pytest.approx(40, rel=1e-5)
    shares = [_visits(1e6, most)[0] / 40 for most in (1, 2, 3)]
    assert 0.5 < shares[0] < shares[1] < shares[2] < 1, shares


def test_visits_to_a_pixel_that_the_chain_has_left_count_anew() -> None:
    few, some, every = (_visits(pixels, 5)[0] for pixels in (1.0, 2.0, 16.0))
    assert few < some < every < 40


# ---- Proposals ----

_FILMS = {"box": {}, "gaussian": {"rfilter": {"type": "gaussian"}},
          "cropped": {"crop_offset_x": 3, "crop_offset_y": 1, "crop_width": 9, "crop_height": 7},
          "lanczos": {"rfilter": {"type": "lanczos"}}}  # fmt: skip


def _contributions(camera: mi.Film, count: int) -> Contribution:
    """At random places."""
    rng = np.random.default_rng(1)
    x, y = (o + rng.random(count, dtype=np.float32) * s
            for o, s in zip(camera.crop_offset(), camera.crop_size()))  # fmt: skip
    value = mi.Float(np.full(count, 2, dtype=np.float32))
    return Contribution(mi.Point2f(mi.Float(x), mi.Float(y)), mi.Color3f(value), value)


@pytest.mark.parametrize("which", ["box", "gaussian", "cropped"])
def test_pixels_with_many_proposals_are_brought_to_the_mean_of_their_neighbours(which) -> None:
    """An image that is the number of proposals becomes the smoothed number."""
    camera = mi.load_dict(sensor(film=film(15, 11, **_FILMS[which]))).film()
    camera.prepare([])
    image, found = FilteredImage(camera, 5), _contributions(camera, 2000)
    image.propose(found)
    image.add(found, mi.Float(1))
    visits = image._visits.tensor()
    filtered, made = (np.array(x)[..., 0] for x in (image._filtered(visits), visits))
    inside = uniform_filter(np.ones_like(made), 5, mode="constant")
    expected = uniform_filter(made, 5, mode="constant") / inside
    np.testing.assert_allclose(filtered, expected, rtol=1e-4)
    assert np.ptp(filtered) < 0.5 * np.ptp(made)


def test_a_pixel_without_proposals_stays_as_it_is() -> None:
    camera = mi.load_dict(sensor(film=film(5, 5))).film()
    camera.prepare([])
    image, found = FilteredImage(camera, 3), _contributions(camera, 1)
    image.add(found, mi.Float(1))
    np.testing.assert_array_equal(
        np.array(image._filtered(image._visits.tensor())), np.array(image._visits.tensor())
    )


# ---- In renders ----

_FILTERS = {"proposal_filter": 7, "most_consecutive": 10}


@pytest.mark.parametrize("name", _FILTERS)
@pytest.mark.parametrize("rfilter", ["box", "lanczos"])
def test_filters_leave_images_sound_and_about_as_bright(name: str, rfilter: str) -> None:
    camera = sensor(film=film(rfilter={"type": rfilter}))
    scene = mi.load_dict(stage(camera=camera, glass=GLASS_BALL))
    parameters = {"outliers": 0.0, "mutations_per_pixel": 100, "chain_length": 100}
    plain, filtered = (
        batches(scene, erpt(**parameters, **more), 64, [5])[0]
        for more in ({}, {name: _FILTERS[name]})
    )
    if rfilter == "box":
        assert_images_are_sound(filtered)
    assert np.abs(filtered - plain).mean() > 1e-3 * plain.mean()
    assert filtered.mean() == pytest.approx(plain.mean(), rel=0.1)
    assert name == "proposal_filter" or filtered.mean() < plain.mean()


@pytest.mark.parametrize("name", _FILTERS)
def test_filters_of_bidirectional_chains_are_refused(name: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=f'"erpt": "{name}" needs "bidirectional"'):
        erpt(bidirectional=True, **{name: 3})
