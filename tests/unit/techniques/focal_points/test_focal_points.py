"""Focal points: the density of directions that lead there, and how lines show where they are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.learner import Learner, Pilot
from mitsuba_ext.planning.planner import LearningPlan, Planner
from mitsuba_ext.planning.technique import Setting
from mitsuba_ext.techniques.focal_points.decisions import FocalScattering
from mitsuba_ext.techniques.focal_points.fitting import LineArrays, fitted_boxes, fitted_rows
from mitsuba_ext.techniques.focal_points.focal_density import FocalDensity
from mitsuba_ext.techniques.focal_points.learner import FocalLearner
from mitsuba_ext.techniques.focal_points.line_records import Lines, change_of_squares
from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.vertex import Vertex
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

#: Two boxes that overlap, one that is thin, and one behind the origin; the row that is used chooses
#: 0.6 of its samples among three of them.
LOW = np.array([[1, -0.5, -0.5], [0.5, 0, -1], [-1, 2, -2], [-3, -1, -1]])
HIGH = np.array([[2, 0.5, 0.5], [1.5, 1, 1], [1, 2.1, 2], [-1, 1, 0.5]])
ROWS = np.array([[0, 0, 0, 0], [0.1, 0.3, 0.2, 0]])

#: A region for all vertices, as :class:`NestedRegions` has them.
ALL = SimpleNamespace(number=lambda p, n, active: mi.UInt32(1))


@pytest.mark.parametrize("p", [(0, 0, 0), (1.2, 0.2, 0.1)], ids=["outside", "inside"])
def test_directions_to_boxes_have_their_density(p: tuple[float, ...]) -> None:
    density, row, active = FocalDensity(LOW, HIGH, ROWS), mi.UInt32(1), mi.Bool(True)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda u: density.sample(row, mi.Point3f(p), u.x, mi.Point2f(u.y, u.z), active),
        pdf_func=lambda d: density.density(row, mi.Point3f(p), d, active),
        sample_dim=3, sample_count=1 << 18, res=60, ires=8,
    )  # fmt: skip
    assert test.run(0.01), test.messages
    np.testing.assert_allclose(density.share(row, active).numpy(), 0.6, rtol=1e-6)
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(np.random.default_rng(1).random((2, 999))))
    both = density.densities(row, mi.Point3f(p), (d, -d), active)
    for found, direction in zip(both, (d, -d)):
        expected = density.density(row, mi.Point3f(p), direction, active)
        np.testing.assert_allclose(found.numpy(), expected.numpy(), rtol=1e-5)


def _vertex(bsdf: dict, count: int) -> Vertex:
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.sh_frame = mi.Frame3f(mi.Normal3f(dr.normalize(mi.Vector3f(0.8, 0.4, 0.4))))
    si.n, si.wi = si.sh_frame.n, dr.normalize(mi.Vector3f(0.5, -0.3, 0.8))
    plugin = mi.load_dict(bsdf)
    vertex = Vertex(si, mi.BSDFPtr(plugin), path=None)
    vertex.held = plugin
    return vertex


@pytest.mark.parametrize("bsdf", [
    {"type": "roughplastic", "alpha": 0.3},
    {"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
], ids=lambda bsdf: bsdf["type"])  # fmt: skip
def test_the_mixture_has_its_density_and_the_mean_of_the_bsdf(bsdf: dict) -> None:
    count, ctx = 1 << 17, mi.BSDFContext()
    focal = FocalScattering(FocalDensity(LOW, HIGH, ROWS), ALL)
    vertex = _vertex(bsdf, count)
    rng = mi.PCG32(size=count)
    u, v = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
    wo = mi.warp.square_to_uniform_hemisphere(v)
    value, pdf, bs, weight, _ = focal.sample(None, ctx, vertex, wo, u, v)
    of_bsdf, bsdf_pdf = vertex.bsdf.eval_pdf(ctx, vertex.si, wo)
    d = vertex.si.to_world(wo)
    to_focus = focal.density.density(mi.UInt32(1), vertex.si.p, d, mi.Bool(True))
    np.testing.assert_allclose(pdf.numpy(), (0.4 * bsdf_pdf + 0.6 * to_focus).numpy(), rtol=1e-4)
    np.testing.assert_allclose(value.numpy(), of_bsdf.numpy(), rtol=1e-5)
    # The density of a sample is the one that MIS weights expect of its direction
    smooth = ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    _, expected = focal.eval_pdf(None, ctx, vertex, bs.wo, smooth)
    is_close = np.isclose(bs.pdf.numpy(), expected.numpy(), rtol=1e-3)
    assert is_close[smooth.numpy()].mean() > 0.999  # others at the edge of a box
    # Means of a function of the direction
    def mean(weight, wo):
        seen = (weight.x * (1 + dr.square(vertex.si.to_world(wo).x))).numpy().astype(float)
        return seen.mean(), seen.std() / np.sqrt(count)

    found, error = mean(weight, bs.wo)
    alone, weight = vertex.bsdf.sample(ctx, vertex.si, u, v)
    exact, other = mean(weight, alone.wo)
    assert abs(found - exact) < 4 * np.hypot(error, other) < 0.04 * exact


def _lines(count: int, hole: np.ndarray, size: float) -> LineArrays:
    """Lines from the walls of a room of 4 m through a hole in one of them."""
    rng = np.random.default_rng(3)
    p = rng.uniform(-2, 2, (count, 3))
    p[np.arange(count), rng.integers(0, 2, count)] = -2  # on two walls
    target = hole + rng.uniform(-size / 2, size / 2, (count, 3)) * [0, 1, 1]
    d = target - p
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    region = 1 + (p[:, 0] > 0)
    one = np.ones(count, np.float32)
    return LineArrays(np.float32(p), np.float32(d), region, 0.2 * one, one)


def test_boxes_are_found_where_lines_cross() -> None:
    hole, size = np.array([2, 0.3, 0.8]), 0.1
    lines = _lines(600, hole, size)
    low, high, probability = fitted_boxes(lines, 32)
    assert len(low) <= 32 and probability.sum() < 1
    edge, middle = (high - low).max(axis=1), (low + high) / 2
    is_near = (np.abs(middle - hole) < size + edge[:, None]).all(axis=1) & (edge < 0.3)
    assert probability[is_near].sum() > 0.7
    rows = fitted_rows(
        lines, low, high, probability, [slice(0, 1), slice(1, 3)], np.array([0, 0, 0])
    )
    assert rows.shape == (3, len(low))
    # BSDF samples keep their part
    assert (rows.sum(axis=1) < 0.8 + 1e-6).all() and (rows[:, is_near].sum(axis=1) > 0.6).all()


def test_one_line_and_equal_points_give_boxes() -> None:
    for count, spread in ((1, 1), (5, 0)):
        lines = _lines(count, np.array([2, 0, 0]), 0.1)
        lines = lines._replace(p=lines.p * np.float32(spread))
        low, high, probability = fitted_boxes(lines, 4)
        assert (high > low).all() and np.isfinite(probability).all()


class _Idle(Learner):
    """Decides ``name`` in each stage."""

    def __init__(self, name: str) -> None:
        self.name, self.is_finished = name, False

    def start(self, scene, p, n):
        return self.name

    def learn(self, pilot):
        return self.name

    def finish(self):
        self.is_finished = True

    def __str__(self):
        return ""


def _planner(**learners: Learner) -> Planner:
    techniques = {
        slot: SimpleNamespace(
            decision=lambda setting: None, learner=lambda *_, x=learner: x, doubles=False,
            tries=True, bytes_per_sample=0,
        )
        for slot, learner in learners.items()
    }  # fmt: skip
    scene = load("cornell_box", width=4, height=4)
    setting = Setting(scene, scene.sensors()[0], 0, 6, 5, 16)
    return Planner(
        techniques, setting, (1, 1, 2, 12), lambda *_: None, Decisions(), LearningPlan((1, 1, 2))
    )


@pytest.mark.parametrize("ends", [False, True])
def test_pilots_weigh_less_whatever_they_find(ends: bool) -> None:
    """If bright pilots were more likely to be left out, the image would be too dark."""
    planner = _planner(scattering=_Idle("focal"))
    stages = [planner.next_stage() for _ in range(2)]
    if ends:  # a trial has left out all learners
        planner._pilot_count = 1
    stages += [planner.next_stage() for _ in range(2)]
    weights = [stage.weight for stage in stages]
    assert weights == sorted(weights) and weights[0] < 0.8 and weights[2] < weights[3] == 1
    assert not any(stage.discards_earlier for stage in stages)


def test_the_rest_of_a_render_without_time_to_learn_has_the_weight_of_the_last_stage() -> None:
    planner = _planner(scattering=_Idle("focal"))
    stages = [planner.next_stage() for _ in range(2)]
    planner.end_learning()
    assert stages[1].weight < planner.next_stage().weight == 1


def test_a_learner_replaces_others() -> None:
    guide, focal = _Idle("guide"), _Idle("focal")
    planner = _planner(directions=guide, scattering=focal)
    planner.next_stage()
    assert planner.decisions.directions == "guide" and not guide.is_finished
    focal.replaces = ("directions", "flights")
    for _ in range(3):
        planner.next_stage()
        assert planner.decisions.directions is None and planner.decisions.scattering == "focal"
    assert guide.is_finished and list(planner.learners) == ["scattering"]


def _learner(monkeypatch, variance: float, rival: Any = None) -> FocalLearner:
    """A learner after a pilot whose lines show boxes with this variance, relative to ``path``."""
    learner = FocalLearner(32, 5, 1.0, 100, (4, 4), rival)
    learner._fitted = FocalScattering(FocalDensity.nothing(2), ALL)
    learner._records = SimpleNamespace(
        lines=lambda: SimpleNamespace(path=range(9999)), paths=50, restart=lambda: None,
        stop=lambda: None,
    )  # fmt: skip
    density = FocalDensity(LOW, HIGH, ROWS)

    def fit(lines, bsdf):
        learner._fitted = FocalScattering(density, ALL)

    def variances(lines, bsdf, density, stride=1):
        return np.full(32, variance), np.ones(32)

    monkeypatch.setattr(learner, "_bsdf_density", lambda lines: None)
    monkeypatch.setattr(learner, "_variances", variances)
    monkeypatch.setattr(learner, "_may_be_worth", lambda *_: True)
    monkeypatch.setattr(learner, "_fit", fit)
    learner.learn(Pilot(None, False))
    return learner


@pytest.mark.parametrize("variance", [0.3, 0.9])
def test_focal_points_are_dropped_if_they_do_not_pay(variance: float, monkeypatch) -> None:
    learner = _learner(monkeypatch, variance)
    assert learner.decision is not None
    learner.learn(Pilot(None, False))
    assert (learner.decision is not None) == (variance < 0.5)


@pytest.mark.parametrize("variance, efficiency, replaces", [
    (0.3, 1.2, True), (0.3, 4.0, False), (0.9, 0.9, False),
])  # fmt: skip
def test_focal_points_replace_a_guide_that_is_less_efficient(
    variance: float, efficiency: float, replaces: bool, monkeypatch
) -> None:
    learner = _learner(monkeypatch, variance, SimpleNamespace(efficiency=efficiency))
    assert learner.decision is None and learner.replaces == ()
    learner.learn(Pilot(None, False))
    assert (learner.decision is not None) == replaces == ("directions" in learner.replaces)
    assert learner.effect.is_kept == replaces
    assert (learner.efficiency > 1) == replaces


@pytest.mark.parametrize("count, through_a_hole, draws", [
    (2000, True, True), (2000, False, False), (200, True, False),
])  # fmt: skip
def test_lines_of_one_pilot_show_whether_there_are_focal_points(
    count: int, through_a_hole: bool, draws: bool
) -> None:
    lines = _lines(count, np.array([2, 0.3, 0.8]), 0.1)
    d = mi.warp.square_to_uniform_sphere(mi.Point2f(np.random.default_rng(1).random((2, count))))
    found = Lines(
        mi.Point3f(lines.p.T), mi.Vector3f(lines.d.T) if through_a_hole else d,
        dr.zeros(mi.UInt32, count), dr.full(mi.Float, 0.2, count), dr.full(mi.Float, 1, count),
        dr.full(mi.Float, 1, count), dr.arange(mi.UInt32, count), dr.zeros(mi.UInt32, count),
    )  # fmt: skip
    learner = FocalLearner(32, 5, 1.0, 10 * count, (4, 4), SimpleNamespace(efficiency=1.5))
    regions = SimpleNamespace(count=1, levels=[slice(0, 1)], parent=np.zeros(1, int))
    learner._fitted = FocalScattering(FocalDensity.nothing(1), regions)
    learner._records = SimpleNamespace(
        lines=lambda: found, paths=count, variances=np.full(32, count / 32),
        restart=lambda: None, stop=lambda: None,
    )  # fmt: skip
    assert (learner.learn(Pilot(None, False)) is not None) == draws
    # Few lines decide nothing until the last pilot, which refuses what it cannot know
    waits = learner._fitted is not None
    assert waits == (draws or count == 200)
    learner.learn(Pilot(None, True))
    assert (learner.decision is not None) == draws == ("directions" in learner.replaces)


def test_the_squares_of_paths_with_other_densities() -> None:
    """Paths 0 and 1 have two bounces; the second bounce of path 1 has found nothing."""
    lines = SimpleNamespace(
        path=mi.UInt32(0, 1, 0), bounce=mi.UInt32(0, 0, 1), value=mi.Float(3, 2, 1)
    )
    change = change_of_squares(lines, np.array([0.5, 3, 4]))
    # Of path 0, light after the first bounce is 2 and 1 after the second
    assert change[0] == pytest.approx((0.5 - 1) * 9 + (0.5 * 4 - 0.5) * 1)
    assert change[1] == pytest.approx((3 - 1) * 4) and not change[2:].any()


def test_without_boxes_directions_are_sampled_as_in_path(monkeypatch) -> None:
    learner = _learner(monkeypatch, 0.3)
    learner._fitted = FocalScattering(FocalDensity.nothing(2), ALL)
    monkeypatch.setattr(learner, "_fit", lambda lines, bsdf: None)
    # The next pilot may find some
    assert learner.learn(Pilot(None, False)) is not None
    assert learner.learn(Pilot(None, True)) is None
    assert str(learner) == "no focal points: the pilots found none"


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator",
    [{"type": "composed_path", "scattering": "focal"}, {"type": "auto_path"}],
    ids=lambda x: x["type"],
)
def test_light_through_a_keyhole_is_found(integrator: dict) -> None:
    """Directions lead to the keyhole, and the unguided pilots do not count towards the image."""
    scene = load("keyhole", width=64, height=36, rfilter="box")
    integrator = mi.load_dict({**integrator, "max_depth": 5})
    integrator.render(scene, spp=192, seed=1)
    learner = integrator.learners["scattering"]
    density = learner.decision.density
    middle = (density.low + density.high) / 2
    is_near = (np.abs(middle - [-1.15, 0.7, 1.1]) < [0.3, 0.2, 0.3]).all(axis=1)
    weight = np.diff(density.table[0, 1:], prepend=0)
    assert weight[is_near].sum() > 0.5, integrator.statistics.learned
    assert learner.effect.variance < 0.4
    assert "directions" not in integrator.learners
