"""Small bright things out of focus are disks of even brightness, and keep their light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.defocus import highlights
from mitsuba_ext.estimators.defocus.images import Pyramid, Size
from mitsuba_ext.estimators.defocus.layers import (
    IN_FOCUS,
    LayerSums,
    Limits,
    layers_from_sums,
    sums_of_picture,
)
from mitsuba_ext.estimators.defocus.lens_filter import lens_filter

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 97, 81


def picture_of(
    bright: np.ndarray, blur: np.ndarray, limits: list[float], **options: float
) -> np.ndarray:
    """The first channel of the picture that the lens makes of a brightness and a blur per pixel."""
    size = Size(bright.shape[1], bright.shape[0])
    color, blurs = (mi.Float(x.ravel().astype(np.float32)) for x in (bright, blur))
    sums = sums_of_picture(mi.Color3f(color), blurs, Limits(limits))
    picture = lens_filter(layers_from_sums(sums, size), size, **options)
    return picture.x.numpy().reshape(bright.shape)


def lamp(background: float = 0.0, blur: float = -20.0, around: float = -20.0):
    """A lamp of one pixel before a wall or a sky."""
    bright, blurs = np.full((HEIGHT, WIDTH), background), np.full((HEIGHT, WIDTH), around)
    bright[HEIGHT // 2, WIDTH // 2], blurs[HEIGHT // 2, WIDTH // 2] = 4000.0, blur
    return bright, blurs


def distance() -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.hypot(x - WIDTH // 2, y - HEIGHT // 2)


@pytest.mark.parametrize("background, around", [(0.0, -20.0), (0.5, -20.0), (0.5, -26.0)])
def test_a_lamp_out_of_focus_is_an_even_disk_of_its_own_radius(background, around):
    image = picture_of(*lamp(background, around=around), [IN_FOCUS]) - background
    inside, outside = distance() < 19, distance() > 21
    assert np.allclose(image[inside], 4000 / (np.pi * 20**2), rtol=0.02)
    assert np.abs(image[outside]).max() < 0.01 * image[inside].mean()
    assert image.sum() == pytest.approx(4000, rel=0.01)


def test_a_lamp_that_two_layers_share_is_shown_once():
    """Its blur is a little more than the limit between two layers."""
    bright, blurs = lamp(blur=-20.0, around=-30.0)
    image = picture_of(bright, blurs, [-IN_FOCUS, -21.0])
    assert image.sum() == pytest.approx(4000, rel=0.02)


@pytest.mark.parametrize("step, share", [(1, 0.5), (21, 1.0), (-19, 0.0)])
def test_a_lamp_is_seen_past_the_objects_before_it(step, share):
    """A dark half plane, blurred by as much on the other side of the focus. The pixel x beside the
    lamp sees it through the lens point x / 20, and the half plane there at 2 x."""
    size, mid = Size(WIDTH, HEIGHT), WIDTH // 2
    bright, _blurs = lamp()
    near = np.zeros((HEIGHT, WIDTH))
    near[:, mid + 2 * step :] = 1
    hits, ones = mi.Float(near.ravel().astype(np.float32)), dr.full(mi.Float, 1, size.count)
    color = mi.Color3f(mi.Float(bright.ravel().astype(np.float32)))
    sums = [LayerSums(mi.Color3f(0) * hits, 20 * hits, hits, ones),
            LayerSums(color, -20 * ones, ones, ones)]  # fmt: skip
    picture = lens_filter(layers_from_sums(sums, size), size)
    assert picture.x.numpy().sum() == pytest.approx(4000 * share, abs=150)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_more_highlights_than_are_affordable_keep_their_light(scale):
    bright = scale * np.random.default_rng(1).pareto(1.2, (HEIGHT, WIDTH))
    blurs = np.full((HEIGHT, WIDTH), -12.0)
    images = [picture_of(bright, blurs, [IN_FOCUS])]
    images.append(picture_of(bright, blurs, [IN_FOCUS], max_covered=0.5))
    inner = slice(24, -24)
    for image in images:
        assert np.isfinite(image).all() and image.min() >= 0
        assert image.mean() == pytest.approx(images[0].mean(), rel=0.05)
    assert images[0][inner, inner].mean() > 0


def test_a_picture_without_highlights_is_left_alone():
    ramp = np.broadcast_to(1 + np.arange(WIDTH) / WIDTH, (HEIGHT, WIDTH))
    size = Size(WIDTH, HEIGHT)
    color = mi.Color3f(mi.Float(ramp.ravel().astype(np.float32)))
    sums = sums_of_picture(color, dr.full(mi.Float, -9, size.count), Limits([]))
    (layer,) = layers_from_sums(sums, size)
    rest, found = highlights.without_highlights(layer, Pyramid(layer.color, size), size)
    assert rest is layer.color and found is None
