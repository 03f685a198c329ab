"""Filters of depth of field on pictures: geometry, energy, borders, and their ends."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import integrate

from mitsuba_ext.estimators.defocus import filters, layers, lens_points
from mitsuba_ext.estimators.defocus.images import Size, filled
from mitsuba_ext.estimators.defocus.near_field import near_field
from mitsuba_ext.estimators.defocus.thin_lens import ThinLens

pytestmark = pytest.mark.usefixtures("variant")

WIDTH, HEIGHT = 128, 64
NEAR, FAR = 1.0, 4.0


def a_lens(focus: float = 2.0, radius: float = 12.0, width: int = WIDTH) -> ThinLens:
    """``radius``: the radius of the circle of confusion of near objects, in pixels."""
    fov = 45.0
    per_unit = abs(1 / NEAR - 1 / focus) * width / (2 * math.tan(math.radians(fov) / 2))
    return ThinLens(radius / per_unit, focus, fov, width)


def blurred(color, depth, lens: ThinLens, name: str = "lens") -> np.ndarray:
    color, depth = (mi.TensorXf(np.asarray(x, dtype=np.float32)) for x in (color, depth))
    return filters.defocus(color, depth, lens, name).numpy()


def layered(parts: list[tuple[np.ndarray, np.ndarray, float]]) -> tuple[list, Size]:
    """Layers of which everything is known: the coverage, the colour and the blur of each."""
    size = Size(parts[0][0].shape[1], parts[0][0].shape[0])
    sums = []
    for coverage, color, blur in parts:
        hits = mi.Float(coverage.ravel().astype(np.float32))
        color = mi.Color3f(mi.Float((coverage * color).ravel().astype(np.float32)))
        sums.append(layers.LayerSums(color, blur * hits, hits, dr.full(mi.Float, 1, size.count)))
    return layers.layers_from_sums(sums, size), size


def of_layers(name: str, parts, cap: float) -> np.ndarray:
    """The first channel of the picture of the ``lens`` or the ``effective`` filter."""
    found, size = layered(parts)
    if name == "lens":
        picture = filters.lens_filter(found, size)
    else:
        near = found.pop(0) if cap > 0 and parts[0][0].any() else None
        picture = filters.effective_filter(near, found, size, cap)
    return picture.x.numpy().reshape(size.height, size.width)


# ---- The lens ----


def test_circle_of_confusion_agrees_with_a_traced_thin_lens():
    """Rays of Mitsuba's sensor, from the edge and the middle of the aperture."""
    lens = ThinLens(0.1, 3.0, 40.0, 200)
    sensor = mi.load_dict({
        "type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3.0, "fov": 40.0,
        "film": {"type": "hdrfilm", "width": 200, "height": 100},
    })  # fmt: skip
    for depth in (0.5, 2.0, 3.0, 9.0):
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(0.3, 0.6), mi.Point2f(1, 0.5))
        p = ray(depth / ray.d.z - ray.o.z / ray.d.z)
        it = dr.zeros(mi.Interaction3f)
        it.p = p
        seen, _ = sensor.sample_direction(it, mi.Point2f(0.5))
        distance = np.hypot(seen.uv.x[0] - 0.3 * 200, seen.uv.y[0] - 0.6 * 100)
        blur = float(lens.blur(mi.Float(depth))[0])
        assert abs(blur) == pytest.approx(distance, abs=2e-3)
        assert np.sign(round(blur, 6)) == np.sign(3.0 - depth)
    assert float(lens.blur(mi.Float(dr.inf))[0]) == pytest.approx(lens.blur_of_sky)
    focused_at_infinity = ThinLens(0.1, math.inf, 40.0, 200)
    assert float(focused_at_infinity.blur(mi.Float(dr.inf))[0]) == 0


@pytest.mark.parametrize("wrong", [
    {"aperture_radius": -1.0}, {"focus_distance": 0.0}, {"fov": 180.0}, {"film_width": 0},
])  # fmt: skip
def test_an_impossible_lens_is_refused(wrong):
    parameters = {"aperture_radius": 0.1, "focus_distance": 3.0, "fov": 40.0, "film_width": 9}
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ThinLens(**{**parameters, **wrong})


def test_points_of_the_lens_are_even():
    points = lens_points.ring_points()
    assert points.shape == (48, 2) and np.allclose(points.mean(axis=0), 0, atol=1e-12)
    assert np.allclose((points**2).mean(axis=0), 0.25, atol=1e-12), "as of the unit disk"


# ---- Geometry: a half plane that is near, before what is far ----

#: Where the far point is behind the edge: the largest coordinate on the lens that sees it.
EDGES = (-0.5, -0.2, 0.0, 0.3, 0.7)
FAR_BLUR, NEAR_BLUR = -16.0, 16.0


def _segment(t: float, moment: int) -> float:
    """The mean of the power of x over the part of the unit disk with x < t, times that part."""
    density = lambda x: x**moment * 2 * math.sqrt(1 - x * x) / math.pi  # noqa: E731
    return integrate.quad(density, -1, t)[0]


def _point_behind_an_edge(name: str, t: float) -> np.ndarray:
    width, height, p = 97, 65, 48
    edge = p + 0.5 + t * (NEAR_BLUR - FAR_BLUR)
    x = np.arange(width)
    near = np.broadcast_to(np.clip(x + 1 - edge, 0, 1), (height, width))
    point = np.zeros((height, width))
    point[height // 2, p] = 1000.0
    parts = [(near, np.zeros((height, width)), NEAR_BLUR),
             (np.ones((height, width)), point, FAR_BLUR)]  # fmt: skip
    return of_layers(name, parts, NEAR_BLUR)


def _moments(image: np.ndarray) -> tuple[float, float, float]:
    """Sum, mean of x, its standard deviation."""
    x = np.arange(image.shape[1])
    weight = image.sum(axis=0)
    mean = (weight * x).sum() / weight.sum()
    return weight.sum(), mean, math.sqrt((weight * (x - mean) ** 2).sum() / weight.sum())


@pytest.mark.parametrize("t", EDGES)
def test_point_behind_an_edge_is_the_part_of_the_disk_that_remains_shifted(t):
    total, mean, width = _moments(_point_behind_an_edge("lens", t))
    share = _segment(t, 0)
    shift = _segment(t, 1) / share
    deviation = math.sqrt(_segment(t, 2) / share - shift**2)
    assert total == pytest.approx(1000 * share, abs=50), "the rest of the disk is dark"
    # Behind the focus, left and right change sides
    assert mean - 48 == pytest.approx(-FAR_BLUR * shift, abs=0.05 * abs(FAR_BLUR))
    assert width == pytest.approx(abs(FAR_BLUR) * deviation, abs=0.05 * abs(FAR_BLUR))


def _bars(name: str, t: float, period: float = 16.0) -> tuple[float, float]:
    """Bars along x behind an edge: the phase and the contrast of their image at the pixel of which
    the lens sees x < t."""
    width, height = 129, 33
    x, middle = np.arange(width), 64
    edge = middle + 0.5 + t * NEAR_BLUR
    near = np.broadcast_to(np.clip(x + 1 - edge, 0, 1), (height, width))
    waves = [np.broadcast_to(1 + f(2 * np.pi * (x - middle) / period), (height, width))
             for f in (np.cos, np.sin)]  # fmt: skip
    found = []
    for wave in (*waves, np.ones((height, width))):
        parts = [(near, np.zeros_like(near), NEAR_BLUR), (np.ones_like(near), wave, FAR_BLUR)]
        # A square of all turns of the points
        found.append(of_layers(name, parts, NEAR_BLUR)[16:20, 62:66].mean(axis=0)[2])
    cos, sin, one = found
    z = complex(cos / one - 1, sin / one - 1)
    return np.angle(z), abs(z)


@pytest.mark.parametrize("t", EDGES)
def test_bars_behind_an_edge_are_shifted_and_sharper_as_geometry_says(t):
    """The image of a wave is the wave times the mean phase over the part of the lens that sees."""
    period = 48.0
    phase, contrast = _bars("lens", t, period)
    k = 2 * math.pi * FAR_BLUR / period
    density = lambda x: 2 * math.sqrt(1 - x * x) / math.pi / _segment(t, 0)  # noqa: E731
    real = integrate.quad(lambda x: math.cos(k * x) * density(x), -1, t)[0]
    imaginary = integrate.quad(lambda x: math.sin(k * x) * density(x), -1, t)[0]
    # In pixels, 5 % of the radius
    expected = math.atan2(imaginary, real)
    assert abs(phase - expected) * period / (2 * math.pi) < 0.05 * abs(FAR_BLUR)
    assert contrast == pytest.approx(math.hypot(real, imaginary), abs=0.05)


@pytest.mark.parametrize("t", [-0.5, 0.0, 0.5])
def test_effective_circle_makes_the_image_narrower_and_moves_it_from_the_edge(t):
    """The source's model: its Gaussian α is steeper than the α of the disk."""
    total, mean, width = _moments(_point_behind_an_edge("effective", t))
    _, centre, whole = _moments(_point_behind_an_edge("effective", 3.0))
    assert centre == pytest.approx(48, abs=0.6) and whole == pytest.approx(8, abs=0.8)
    assert width < 0.95 * whole and mean < centre - 1 and total < 990


# ---- Ends ----


@pytest.mark.parametrize("name", filters.FILTERS)
@pytest.mark.parametrize("value", [0.0, 1.0, 3e4])
def test_a_constant_picture_stays_constant_up_to_its_border(name, value):
    random = np.random.default_rng(1)
    depth = np.repeat(np.repeat(random.choice([1.0, 1.3, 2.0, 4.0, np.inf], (8, 16)), 8, 0), 8, 1)
    found = blurred(np.full((HEIGHT, WIDTH, 3), value), depth, a_lens(), name)
    assert np.allclose(found, value, rtol=1e-4)


@pytest.mark.parametrize("name", filters.FILTERS)
def test_pixels_in_focus_are_left_alone(name):
    color = np.random.default_rng(1).random((HEIGHT, WIDTH, 3))
    found = blurred(color, np.full((HEIGHT, WIDTH), 2.0), a_lens(), name)
    assert np.allclose(found, color, atol=1e-5)
    without_aperture = ThinLens(0.0, 2.0, 45.0, WIDTH)
    found = blurred(color, np.full((HEIGHT, WIDTH), 5.0), without_aperture, name)
    assert np.allclose(found, color, atol=1e-5)


@pytest.mark.parametrize("name", filters.FILTERS)
@pytest.mark.parametrize("focus", [NEAR, math.inf])
def test_focus_at_the_near_plane_and_at_infinity(name, focus):
    color = np.random.default_rng(1).random((HEIGHT, WIDTH, 3))
    depth = np.full((HEIGHT, WIDTH), np.inf)
    depth[:, : WIDTH // 2] = NEAR
    lens = ThinLens(0.2, focus, 45.0, WIDTH)
    found = blurred(color, depth, lens, name)
    assert np.isfinite(found).all()
    sharp = np.s_[:, 4 : WIDTH // 4] if focus == NEAR else np.s_[:, -8:]
    soft = np.s_[16:48, -40:-20] if focus == NEAR else np.s_[16:48, 20:30]
    assert np.allclose(found[sharp], color[sharp], atol=0.02)
    assert found[soft].std() < 0.5 * color[soft].std()


@pytest.mark.parametrize("name", filters.FILTERS)
@pytest.mark.parametrize("depth", [NEAR, 2.0, FAR, np.inf])
def test_one_pixel_is_left_alone(name, depth):
    found = blurred([[[0.5, 1.0, 2.0]]], [[depth]], a_lens(width=1), name)
    assert np.allclose(found, [0.5, 1.0, 2.0])


def test_opacity_of_the_near_layer_of_0_and_1():
    random = np.random.default_rng(1)
    far = (np.ones((33, 65)), random.random((33, 65)), FAR_BLUR)
    for name in ("lens", "effective"):
        nothing = of_layers(name, [(np.zeros((33, 65)), np.zeros((33, 65)), 16.0), far], 16.0)
        alone = of_layers(name, [far], 0.0)
        assert np.allclose(nothing, alone, atol=1e-5)
        everything = of_layers(name, [(np.ones((33, 65)), np.full((33, 65), 7.0), 16.0), far], 16.0)
        assert np.allclose(everything, 7)


@pytest.mark.parametrize("blurs", [(16.0, 6.0), (-6.0, -16.0)])
def test_the_nearer_of_two_near_or_two_far_objects_hides_the_other(blurs):
    """A half plane before what is bright: its edge is as wide as its own circle."""
    x = np.broadcast_to(np.arange(129), (33, 129))
    front = (x >= 64).astype(float)
    parts = [(front, 0 * front, blurs[0]), (1 + 0 * front, 1 + 0 * front, blurs[1])]
    image = of_layers("lens", parts, 0.0)[16]
    edge = np.clip((64 - np.arange(129) - 0.5) / abs(blurs[0]), -1, 1)
    assert np.abs(image - [_segment(t, 0) for t in edge]).max() < 0.06


def test_holes_are_filled_from_around_and_known_pixels_stay():
    size = Size(37, 21)
    random = np.random.default_rng(1)
    known = (random.random(size.count) < 0.2).astype(np.float32)
    values = (1 + random.random(size.count)).astype(np.float32)
    found = filled(mi.Float, mi.Float(values * known), mi.Float(known), size).numpy()
    assert np.allclose(found[known == 1], values[known == 1], atol=1e-5)
    assert found.min() >= 1 - 1e-5 and found.max() <= 2 + 1e-5
    assert not filled(mi.Float, mi.Float(0 * known), mi.Float(0 * known), size).numpy().any()


def test_near_filter_points_at_the_objects():
    height, width = 48, 64
    coverage = np.zeros((height, width), dtype=np.float32)
    coverage[:, 40:] = 1
    color = dr.ravel(mi.Vector4f(0, 0, 0, mi.Float(coverage.ravel())))
    for radius in (6.0, 30.0):
        found = near_field(layers.Layer(color, dr.full(mi.Float, radius, width * height)),
                           Size(width, height), radius)  # fmt: skip
        direction = found.direction.numpy().reshape(2, height, width)[:, 24, 38]
        assert np.allclose(direction, [1, 0], atol=1e-3)
        alpha = found.color.w.numpy().reshape(height, width)[24]
        assert (np.diff(alpha) > -1e-5).all() and alpha[39] == pytest.approx(0.45, abs=0.1)


def test_limits_are_in_gaps():
    blurs = np.concatenate([np.full(50, 20.0), np.full(50, 5.0), np.zeros(9), np.full(50, -4.0),
                            np.full(50, -12.0)])  # fmt: skip
    found = layers.limits_of(blurs).blurs
    assert len(found) == 4 and found == sorted(found, reverse=True)
    assert 5 < found[0] < 20 and found[1:3] == [1.0, -1.0] and -12 < found[3] < -4
    assert layers.limits_of(np.full(9, 3.0)).blurs == [1.0]
    assert layers.limits_of(np.zeros(9)).blurs == []


def test_wrong_pictures_and_names_are_refused():
    color, depth = mi.TensorXf(np.zeros((4, 5, 3))), mi.TensorXf(np.zeros((5, 4)))
    with pytest.raises(ValueError, match=r"\(5, 4\)"):
        filters.defocus(color, depth, a_lens())
    with pytest.raises(ValueError, match="lens, effective"):
        filters.defocus(color, mi.TensorXf(np.ones((4, 5))), a_lens(), "bokeh")
