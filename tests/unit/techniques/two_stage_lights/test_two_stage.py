"""Two-stage importance sampling: sums of texels, partitions, and directions from them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.scene.lights.environment_texels import EnvironmentTexels
from mitsuba_ext.scene.lights.texel_sums import Corners, TexelSums
from mitsuba_ext.techniques.two_stage_lights.environment_partition import Partitioner
from mitsuba_ext.techniques.two_stage_lights.two_stage import TwoStage
from mitsuba_ext.transport.path_decisions import EmitterSampling, LightNumbers
from mitsuba_ext.util.spectra import brightness
from tests.support.environments import (
    BSDFS,
    LANES,
    MORE_ENVIRONMENTS,
    directions_everywhere,
    floor_below,
    floor_vertex,
    random_point,
)
from tests.support.statistical import batches, load, one_thread, some

pytestmark = pytest.mark.usefixtures("variant")


def _partitioner(scene: mi.Scene, splits: int) -> Partitioner:
    return Partitioner(TexelSums(EnvironmentTexels(scene)), mi.BSDFContext(), splits)


# ---- Sums ----


@pytest.mark.parametrize("name", ["sun", "half black", "odd"])
def test_shares_are_sums_of_texels(name: str) -> None:
    texels = EnvironmentTexels(floor_below(name, "diffuse"))
    sums = TexelSums(texels)
    weight = texels.corners().mean(axis=1).reshape(texels.rows, texels.columns)
    rng = np.random.default_rng(3)
    x = np.sort(rng.integers(0, texels.columns + 1, (2, 500)), axis=0).astype(np.uint32)
    y = np.sort(rng.integers(0, texels.rows + 1, (2, 500)), axis=0).astype(np.uint32)
    found = sums.rectangle(
        mi.UInt32(x[0]), mi.UInt32(y[0]), mi.UInt32(x[1]), mi.UInt32(y[1]), Corners(0, 0, 0, 0),
        mi.Bool(True),
    ).share.numpy()  # fmt: skip
    expected = [
        weight[c:d, a:b].sum() / weight.sum() for (a, b, c, d) in zip(x[0], x[1], y[0], y[1])
    ]
    # Also of black texels beside the sun
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-15)


@pytest.mark.slow
def test_a_table_of_a_large_map_needs_96_mib() -> None:
    """The map has 4096 x 2048 texels, with 12 bytes each."""
    pixels = np.random.default_rng(4).random((2048, 4096, 3), dtype=np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels)}
    scene = mi.load_dict({"type": "scene", "e": sky, "ball": {"type": "sphere"}})
    sums = TexelSums(EnvironmentTexels(scene))
    assert len(sums._sums) * 8 + len(sums._nodes) * 4 == pytest.approx(96 * 2**20, rel=1e-3)
    half = sums.rectangle(
        mi.UInt32(0), mi.UInt32(0), mi.UInt32(4096), mi.UInt32(1024), Corners(0, 0, 0, 0),
        mi.Bool(True),
    )  # fmt: skip
    assert half.share[0] == pytest.approx(0.5, rel=1e-3)


# ---- Directions ----


_PAIRS = [
    *(("turned", bsdf) for bsdf in BSDFS), *((name, "metal") for name in MORE_ENVIRONMENTS),
    ("sun", "diffuse"), ("sun in the zenith", "coated"), ("sky", "glass"),
]  # fmt: skip

_QUICK = [("turned", "diffuse"), ("turned", "glass"), ("sun", "metal"), ("sky", "metal")]


@pytest.mark.parametrize("environment, bsdf", [
    pytest.param(*pair, marks=() if pair in _QUICK else pytest.mark.slow)
    for pair in dict.fromkeys(_PAIRS)
])  # fmt: skip
def test_directions_are_distributed_by_the_density(environment: str, bsdf: str) -> None:
    """The density that a sample has is found again; it integrates to one; and a chi² test: samples
    are counted, directions everywhere integrate the density."""
    scene = floor_below(environment, bsdf)
    partitioner, si, active = _partitioner(scene, 16), floor_vertex(scene), mi.Bool(True)
    numbers = mi.PCG32(size=LANES)
    made = partitioner.partition(si, active)
    d, _uv, density = partitioner.sample(made, random_point(numbers), active)
    found = partitioner.pdf(made, d, active)
    other, by_area = directions_everywhere(environment, numbers)
    pdf = partitioner.pdf(made, other, active)
    dr.eval(d, density, found, other, by_area, pdf)

    d, density, found, other, by_area, pdf = (
        value.numpy() for value in (d, density, found, other, by_area, pdf)
    )
    assert np.isfinite(density).all() and np.isfinite(pdf).all() and pdf.min() > 0
    # What is lost lies at the edge of the sun
    kept = density > 0
    assert kept.mean() > 0.998
    ratio = found[kept] / density[kept]
    assert np.mean(np.abs(ratio - 1) > 1e-2) < 1e-3

    value = pdf / by_area
    error = value.std() / np.sqrt(LANES)
    assert error < 0.1 and abs(value.mean() - kept.mean()) < 4.5 * error + 2e-3

    edges = [np.linspace(-np.pi, np.pi, 17), np.linspace(-1, 1, 10)]

    def histogram(d: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        return np.histogram2d(np.arctan2(d[1], d[0]), d[2], edges, weights=weights)[0]

    observed, expected = histogram(d[:, kept]), histogram(other, value)
    square = histogram(other, value**2)
    count = histogram(other)
    used = (expected > 50) & (count > 50)
    variance = expected + square - expected**2 / LANES
    chi2 = np.sum((observed - expected)[used] ** 2 / variance[used])
    assert used.sum() > 2 and stats.chi2.sf(chi2, used.sum()) > 1e-4


def _connections(
    decision: Any, scene: mi.Scene, si: mi.SurfaceInteraction3f
) -> np.ndarray:
    """What connections bring if nothing is in between."""
    numbers, active = mi.PCG32(size=dr.width(si)), mi.Bool(True)
    place = decision.visit(decision.begin(None, None), scene, si, active)
    ds, weight, _ = decision.sample(place, scene, LightNumbers(random_point(numbers)), si, active)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d)) * weight
    return dr.select(ds.pdf > 0, brightness(value), 0).numpy()


@pytest.mark.parametrize("environment, bsdf, gain", [
    ("turned", "diffuse", 2.5), pytest.param("sun", "coated", 1.3, marks=pytest.mark.slow),
    pytest.param("turned", "metal", 2, marks=pytest.mark.slow),
])  # fmt: skip
def test_directions_follow_the_product_of_light_and_bsdf(
    environment: str, bsdf: str, gain: float
) -> None:
    """The mean agrees with light samples, and the noise is lower."""
    scene = floor_below(environment, bsdf)
    si = floor_vertex(scene)
    two_stage = _connections(TwoStage(scene, 16, False), scene, si)
    plain = _connections(EmitterSampling(), scene, si)
    error = np.hypot(two_stage.std(), plain.std()) / np.sqrt(LANES)
    assert abs(two_stage.mean() - plain.mean()) < 4 * error
    assert gain * two_stage.std() < plain.std()


def test_more_divisions_are_less_noisy() -> None:
    scene = floor_below("turned", "diffuse")
    si = floor_vertex(scene)
    noise = [_connections(TwoStage(scene, n, False), scene, si).std() for n in (0, 16, 128)]
    assert noise[0] > 1.2 * noise[1] > 1.2 * noise[2]


def test_later_vertices_choose_as_path_does() -> None:
    scene = floor_below("turned", "metal")
    si, active, numbers = floor_vertex(scene), mi.Bool(True), mi.PCG32(size=LANES)
    ds = dr.zeros(mi.DirectionSample3f, LANES)
    ds.d = mi.warp.square_to_uniform_sphere(random_point(numbers))
    ds.emitter = mi.EmitterPtr(scene.environment())
    expected = scene.pdf_emitter_direction(si, ds, active).numpy()
    for everywhere in (False, True):
        decision = TwoStage(scene, 8, everywhere)
        state, is_same = decision.begin(None, None), []
        for _ in range(3):
            place = decision.visit(state, scene, si, active)
            state = decision.remember(place, scene, ds.d, mi.Float(0), active)
            density = decision.density(state, scene, mi.Interaction3f(si), None, ds, active)
            is_same.append(np.allclose(density.numpy(), expected, rtol=1e-3))
        assert is_same == [False, not everywhere, not everywhere]


@pytest.mark.parametrize("lamp", some("none", of=("none", "area", "point")))
def test_other_lights_are_connected_to_as_well(lamp: str) -> None:
    """Seen from a floor below an opaque sky and a lamp: as much light as ``path`` finds."""
    lamps: dict[str, Any] = {
        "none": {},
        "area": {"lamp": {"type": "sphere", "radius": 0.2, "center": [0, 0, 1],
                          "emitter": {"type": "area", "radiance": 4.0}}},
        "point": {"lamp": {"type": "point", "position": [0, 0, 1]}},
    }  # fmt: skip
    scene = mi.load_dict({
        "type": "scene", "e": MORE_ENVIRONMENTS["turned"](), **lamps[lamp],
        "floor": {"type": "rectangle", "bsdf": BSDFS["coated"]},
        "sensor": {"type": "perspective", "fov": 30,
                   "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
                   "to_world": mi.ScalarTransform4f().look_at([0, -2, 2], [0, 0, 0], [0, 0, 1])},
    })  # fmt: skip
    parameters = {"max_depth": 2}
    means = [
        batches(scene, mi.load_dict({"type": name, **parameters}), 256, seeds).mean(axis=(1, 2, 3))
        for name, seeds in (("path", range(1001, 1009)), ("two_stage", range(1, 9)))
    ]
    error = np.hypot(*(m.std(ddof=1) / np.sqrt(len(m)) for m in means))
    assert abs(means[0].mean() - means[1].mean()) < 4.5 * error
    assert error < 0.01 * means[0].mean()


# ---- In a scene ----


def test_without_an_environment_it_is_path() -> None:
    scene = load("cornell_box", width=8, height=8, rfilter="box")
    images = [
        batches(scene, mi.load_dict({"type": "composed_path", "max_depth": 3, **slots}), 4, [1])
        for slots in ({}, {"next_event": "two_stage"})
    ]
    np.testing.assert_allclose(*images, rtol=1e-5)


def test_two_stage_is_composed_path() -> None:
    scene = load("sunny_gloss", width=16, height=9, rfilter="box")
    slots = {"next_event": {"type": "two_stage_lights", "splits": 5}, "connections": 3}
    images = []
    for integrator in (
        {"type": "two_stage", "light_samples": 3, "splits": 5},
        {"type": "composed_path", **slots},
    ):
        with one_thread():
            images.append(batches(scene, mi.load_dict({**integrator, "max_depth": 3}), 2, [1]))
    np.testing.assert_array_equal(*images)


def test_light_paths_refuse_it() -> None:
    with pytest.raises((RuntimeError, ValueError), match='"two_stage_lights".*without light paths'):
        mi.load_dict({"type": "bdpt", "next_event": "two_stage"})
