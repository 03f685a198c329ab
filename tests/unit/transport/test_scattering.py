"""Another distribution of directions can be mixed into the walk's: unbiased, with one connection of
a vertex and with many."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.observer import Observer
from mitsuba_ext.transport.path_decisions import Scattering
from mitsuba_ext.transport.walk import Walk
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_pixels_on_average,
    load,
    two_halves,
)
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")


class UniformMixture(Scattering):
    """A share of the directions is uniform on the sphere, wherever a BSDF has a lobe that is not
    discrete. One-sample MIS: the density is the density of the mixture. Discrete lobes are left to
    the BSDF."""

    def __init__(self, share: float) -> None:
        self._share = dr.opaque(mi.Float, share)

    def sample(self, state, ctx, vertex, wo, sample_1, sample_2):
        share = self._share_at(vertex)
        is_uniform = sample_1 < share
        rest = dr.select(is_uniform, 0, (sample_1 - share) / dr.maximum(1 - share, 1e-6))
        rest = dr.minimum(rest, dr.one_minus_epsilon(mi.Float))
        bs, weight = vertex.bsdf.sample(ctx, vertex.si, rest, sample_2)
        is_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & ~is_uniform

        # Where the BSDF's own sample failed, the path ends as it does without the mixture
        direction = dr.select(is_uniform, mi.warp.square_to_uniform_sphere(sample_2), bs.wo)
        value, pdf = self.eval_pdf(state, ctx, vertex, direction, mi.Bool(True))
        mixed = dr.select(pdf > 0, value / pdf, 0)
        failed = ~is_uniform & (bs.pdf == 0)
        weight = dr.select(is_delta, weight / dr.maximum(1 - share, 1e-6), mixed)
        weight = dr.select(failed, 0, weight)

        bs.pdf = dr.select(is_delta, bs.pdf * (1 - share), pdf)
        bs.wo = direction
        bs.eta = dr.select(is_uniform, 1, bs.eta)
        smooth = mi.UInt32(int(mi.BSDFFlags.DiffuseReflection))
        bs.sampled_type = dr.select(is_uniform, smooth, bs.sampled_type)
        return *self.eval_pdf(state, ctx, vertex, wo, mi.Bool(True)), bs, weight, state

    def eval_pdf(self, state, ctx, vertex, wo, active):
        value, pdf = vertex.bsdf.eval_pdf(ctx, vertex.si, wo, active)
        share = self._share_at(vertex)
        return value, dr.fma(share, dr.inv_four_pi, (1 - share) * pdf)

    def _share_at(self, vertex) -> mi.Float:
        is_smooth = mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Smooth)
        return dr.select(is_smooth, self._share, 0)


def _mixing(max_depth: int, share: float, **slots: Any) -> mi.Integrator:
    integrator = mi.load_dict({"type": "composed_path", "max_depth": max_depth, **slots})
    make = integrator.walk

    def walk(decisions: Decisions, observer: Observer | None = None) -> Walk:
        return make(replace(decisions, scattering=UniformMixture(share)), observer)

    integrator.walk = walk
    return integrator


_FOUR = {"connections": {"type": "weighted_connections", "count": 4, "vertices": "all"}}


@pytest.mark.parametrize(("scene_name", "max_depth", "share", "slots"), [
    ("cornell_box", 6, 0.5, {}),
    ("mirrors_and_glass", 3, 0.5, {}),
    ("cornell_box", 6, 0.3, _FOUR),
    pytest.param("mirrors_and_glass", 3, 0.3, _FOUR, marks=pytest.mark.slow),
    pytest.param("cornell_box", 6, 0.5, {"connections": 0}, marks=pytest.mark.slow),
    pytest.param("cornell_box", 6, 0.5, {"directions": {"type": "guided_directions",
                                                        "always_guide": True}},
                 marks=pytest.mark.slow),
], ids=lambda value: "-".join(value) if isinstance(value, dict) else str(value))  # fmt: skip
def test_a_mixture_of_directions_has_the_mean_of_path(
    scene_name: str, max_depth: int, share: float, slots: dict[str, Any]
) -> None:
    scene = load(scene_name, width=32, height=18, rfilter="box")
    expected = two_halves(scene, REFERENCE.make(max_depth), 2048, REFERENCE_SEEDS)
    images = two_halves(scene, _mixing(max_depth, share, **slots), 1024, SEEDS)
    precision = 0.03 if scene_name != "cornell_box" else 0.015 if "connections" in slots else 0.01
    assert_same_pixels_on_average(images, expected, precision)


def test_the_mixture_is_used() -> None:
    """Half of the directions of a mostly closed box go into surfaces: other paths, other noise."""
    scene = load("cornell_box", width=8, height=8, rfilter="box")
    plain, mixed = (_mixing(3, share) for share in (0.0, 0.5))
    a, b, c = (
        two_halves(scene, integrator, 32, SEEDS)
        for integrator in (plain, REFERENCE.make(3), mixed)
    )
    assert abs(a - b).max() < 1e-3 * b.mean() < abs(c - b).max()
