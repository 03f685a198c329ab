"""Pairs of samples for derivatives with respect to roughness."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.gradients import RoughBSDFs
from mitsuba_ext.transport.mirrored_directions import (
    MirroredDirections,
    PairedNumbers,
    mirrored_beckmann,
    mirrored_ggx,
)
from mitsuba_ext.transport.path_decisions import DirectionSamples
from mitsuba_ext.transport.vertex import PathState, Vertex
from tests.support.stage import bitmap, film, rgb, sensor

pytestmark = pytest.mark.usefixtures("variant")

MAPS = {
    "ggx": lambda u: mirrored_ggx(u, mi.Bool(True)),
    "beckmann": lambda u: mirrored_beckmann(u, mi.Bool(True)),
    "beckmann, later": lambda u: mirrored_beckmann(u, mi.Bool(False)),
}


def numbers(count: int) -> mi.Point2f:
    generator = mi.PCG32(count)
    return mi.Point2f(generator.next_float32(), generator.next_float32())


@pytest.mark.parametrize("distribution", MAPS)
def test_mirrored_numbers_have_the_density_that_their_weight_says(distribution: str) -> None:
    count, bins = 1 << 18, 8
    mirrored, stretch = MAPS[distribution](numbers(count))
    stretch = np.broadcast_to(stretch.numpy(), count)
    cell = np.floor(mirrored.numpy() * bins).astype(int)
    assert cell.min() >= 0 and cell.max() < bins
    cell = cell[0] * bins + cell[1]
    sums, squares = (np.bincount(cell, stretch**n, bins * bins) for n in (1, 2))
    χ2 = (np.square(sums - count / bins**2) / squares).sum()
    assert χ2 < bins**2 + 5 * np.sqrt(2 * bins**2), χ2


@pytest.mark.parametrize("distribution", MAPS)
def test_twice_mirrored_numbers_are_the_first_ones(distribution: str) -> None:
    u = numbers(1 << 12)
    mirrored, stretch = MAPS[distribution](u)
    again, back = MAPS[distribution](mirrored)
    # Where floats are dense enough: the two numbers are not equally close to the edges
    known = np.abs(stretch.numpy() * back.numpy() - 1) < 0.05
    assert np.mean(known) > 0.9
    distance = np.abs(u.numpy() - again.numpy()).max(axis=0)
    assert np.median(distance) < 1e-5 and np.quantile(distance, 0.9) < 1e-2


def of_roughness(bsdf: mi.BSDF, u: mi.Point2f, sine: float) -> np.ndarray:
    """The derivative of the BSDF's samples with respect to its roughness."""
    parameters, count = mi.traverse(bsdf), dr.width(u)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(sine, 0, (1 - sine**2) ** 0.5)
    bs, _ = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), u)
    dr.eval(bs)
    α = mi.Float(parameters["alpha.value"])
    dr.enable_grad(α)
    parameters["alpha.value"] = α
    parameters.update()
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    dr.set_grad(α, 1)
    derivative = dr.forward_to(value.x)
    parameters["alpha.value"] = dr.detach(α)
    parameters.update()
    return np.array(dr.select(pdf > 0, derivative / dr.detach(pdf), 0))


@pytest.mark.parametrize("distribution, sine", [("ggx", 0.1), ("ggx", 0.6), ("beckmann", 0.6)])
def test_derivatives_of_a_pair_cancel(distribution: str, sine: float) -> None:
    bsdf = mi.load_dict({"type": "roughconductor", "alpha": 0.05, "distribution": distribution})
    u = numbers(1 << 14)
    mirrored, stretch = MAPS[distribution](u)
    first = of_roughness(bsdf, u, sine)
    second = of_roughness(bsdf, mirrored, sine) * stretch.numpy()
    assert np.mean(first**2) > 100
    assert np.mean(((first + second) / 2) ** 2) < 0.05 * np.mean(first**2)


SKY = {"type": "envmap", "bitmap": bitmap(np.random.default_rng(2).uniform(0.5, 1.5, (4, 8, 3)))}


def ball(kind: str, **parameters: Any) -> mi.Scene:
    shape = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.8,
             "bsdf": {"type": kind, **parameters}}  # fmt: skip
    return mi.load_dict(
        {"type": "scene", "sensor": sensor(film=film(24, 24)), "sky": SKY, "ball": shape},
        optimize=False,
    )


def test_the_second_of_two_lanes_has_the_mirrored_numbers_and_their_weight() -> None:
    scene = ball("roughconductor", alpha=0.1)
    known = mi.traverse(scene)
    dr.enable_grad(known["ball.bsdf.alpha.value"])
    known.update()
    decision = MirroredDirections(DirectionSamples(), RoughBSDFs.of(scene))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 64)
    numbers = PairedNumbers.begin(sampler, 5)
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.wi = mi.Vector3f(0, 0, 1)
    # Half of the lanes arrive at a grazing angle, where there are no pairs
    si.wi[dr.arange(mi.UInt32, 64) >= 32] = mi.Vector3f(0.99, 0, 0.14)
    path = PathState(mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0), None, None)
    vertex = Vertex(si, mi.BSDFPtr(scene.shapes()[0].bsdf()), path)
    sample_1, sample_2, weight, _ = decision.draw(None, numbers, vertex, mi.Bool(True))
    choice, u, weight = sample_1.numpy(), sample_2.numpy(), weight.numpy()
    mirrored, stretch = mirrored_beckmann(mi.Point2f(u[:, :32:2]), mi.Bool(True))
    np.testing.assert_allclose(u[:, 1:32:2], mirrored.numpy(), atol=1e-5)
    np.testing.assert_allclose(weight[1:32:2], stretch.numpy(), rtol=1e-3)
    assert (choice[1:32:2] == choice[:32:2]).all() and (choice[33::2] != choice[32::2]).all()
    assert (weight[::2] == 1).all() and (weight[32:] == 1).all()


@pytest.mark.parametrize(
    "kind, parameters, ratio",
    [
        ("roughconductor", {"alpha": 0.05, "distribution": "ggx"}, 0.6),
        pytest.param("roughconductor", {"alpha": 0.1}, 0.5, marks=pytest.mark.slow),
        pytest.param("roughdielectric", {"alpha": 0.1}, 0.8, marks=pytest.mark.slow),
        pytest.param("roughplastic", {"alpha": 0.1}, 1.6, marks=pytest.mark.slow),
        pytest.param("roughconductor", {"alpha": 0.8}, 1.6, marks=pytest.mark.slow),
        pytest.param("principled", {"roughness": 0.25, "metallic": 1.0, "base_color": rgb(0.8)},
                     0.8, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_mean_gradient_of_roughness_is_that_of_prb(
    kind: str, parameters: dict[str, Any], ratio: float
) -> None:
    scene = ball(kind, **parameters)
    known = mi.traverse(scene)
    key = next(k for k in known.keys() if {"alpha", "roughness"} & set(k.split(".")))
    weights = np.random.default_rng(5).uniform(0.5, 1.5, (24, 24, 3)).astype(np.float32)

    def gradients(name: str, first: int) -> np.ndarray:
        integrator, found = mi.load_dict({"type": name, "max_depth": 4}), []
        for seed in range(first, first + 24):
            dr.enable_grad(known[key])
            dr.set_grad(known[key], 0)
            known.update()
            integrator.render_backward(scene, known, mi.TensorXf(weights), seed=seed, spp=6)
            found.append(float(np.sum(np.array(dr.grad(known[key])))))
        return np.array(found)

    ours, theirs = gradients("composed_prb", 0), gradients("prb", 1000)
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 24)
    assert abs(ours.mean() - theirs.mean()) < 4.5 * error
    assert ours.var(ddof=1) < ratio * theirs.var(ddof=1)
