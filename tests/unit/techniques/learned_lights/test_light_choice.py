"""The choice of a light: weights, probabilities, densities, and when learning is given up."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.costs import SEGMENT, SHADOW, TABLE
from mitsuba_ext.planning.learner import Pilot
from mitsuba_ext.scene.lights.choice import Choice
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.lights.weights import cell_means, uniform_weights
from mitsuba_ext.techniques.learned_lights.learner import LightMapLearner
from mitsuba_ext.transport.light_table import LightTable, OneRow
from mitsuba_ext.transport.rejection_law import RejectionLaw
from tests.support.lights import ball
from tests.support.maps import (
    connect,
    floor,
    lamp,
    learner_of,
    map_of,
    observe,
    row_of,
    surface,
    vertex_at,
)

pytestmark = pytest.mark.usefixtures("variant")


def _sampler(lanes: int) -> mi.Sampler:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, lanes)
    return sampler


# ---- Probabilities and densities ----


def test_the_density_of_a_light_that_is_hit_is_the_density_of_choosing_it():
    light_map = map_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1), c=lamp(-0.5, 0, 1)))
    scene = light_map.cells._emitters._scene
    weights = np.tile([1, 2, 5], light_map.rows.count).astype(np.float32)
    selection = LightTable(light_map.rows, light_map.cells, mi.Float(weights))
    lanes = 1 << 12
    si = surface((0.1, 0.1, 0), width=lanes)
    ds, _weight, _choice, state = connect(selection, scene, _sampler(lanes), si)
    hit = scene.ray_intersect(si.spawn_ray(ds.d))
    found = mi.DirectionSample3f(scene, hit, si)
    pdf = selection.density(state, scene, si, hit, found, mi.Bool(True))
    # At the edge of a cell, rounding may find its neighbour
    assert np.mean(np.isclose(pdf.numpy(), ds.pdf.numpy(), rtol=1e-3)) > 0.99


class _Cells:
    """Cells of which only the number matters."""

    def __init__(self, count: int) -> None:
        self.count = count

    def first_cells(self):
        return np.zeros(1, np.uint32)

    def sample(self, cell, si, x, active):
        return dr.zeros(mi.DirectionSample3f, dr.width(cell)), mi.Color3f(1)


@pytest.mark.parametrize("count", [10_000, 16_384])
def test_dim_lights_among_many_are_chosen_with_their_probability(count: int):
    lanes, rounds = 1 << 22, 8
    weights = np.full(count, 1e-3, np.float32) * np.linspace(0.9, 1.1, count, dtype=np.float32)
    weights[::20] = 20
    selection = LightTable(OneRow(), _Cells(count), mi.Float(weights))
    sampler, si = _sampler(lanes), dr.zeros(mi.SurfaceInteraction3f, lanes)
    chosen = np.zeros(count)
    for _ in range(rounds):
        choice = connect(selection, None, sampler, si)[2]
        chosen += np.bincount(choice.cell.numpy(), minlength=count)
    expected = rounds * lanes * weights / weights.sum(dtype=float)
    is_dim = weights < 1
    total = expected[is_dim].sum()
    assert abs(chosen[is_dim].sum() - total) < 5 * np.sqrt(total)
    # Each of them, too: about three times, or not at all
    assert np.mean(np.square(chosen - expected)[is_dim] / expected[is_dim]) == pytest.approx(1, 0.1)


def test_no_light_has_less_than_its_defensive_share():
    learner = learner_of(floor(a=lamp(0, 0, 1), b=lamp(0.5, 0, 1)))
    light_map = learner.map
    observe(light_map, 0, 0, 100_000, 0.0)
    observe(light_map, 1, 100_000, 0, row_of(light_map, light_map.unoccluded)[1])
    p = row_of(light_map, learner._probabilities(light_map.weights("contribution")))
    assert p.min() >= 0.99 * 0.05 / light_map.cells.count and p.sum() == pytest.approx(1)


def test_a_beam_that_the_expectation_misses_keeps_a_share_as_large_as_in_path():
    """The beam does not get the share of one of hundreds of bins of the sky."""
    look = mi.ScalarTransform4f().look_at([0.1, 0.1, 1], [0.1, 0.1, 0], [0, 1, 0])
    beam = {"type": "spot", "cutoff_angle": 0.1, "to_world": look}
    scene = floor(beam=beam, sky={"type": "constant"})
    learner = learner_of(scene, grid=2)
    beam_cell = [e.class_name() for e in scene.emitters()].index("SpotLight")
    cells = learner.map.cells
    p = row_of(learner.map, learner._probabilities(learner.map.unoccluded))
    assert cells.count > 500
    assert 0.024 < p[cells.emitter_index == beam_cell].item() < 0.1


def test_lights_without_sampling_weight_stay_dark_where_no_other_light_arrives():
    look = mi.ScalarTransform4f().look_at([-0.8, 0, 1], [-0.8, 0, 0], [0, 1, 0])
    scene = floor(
        spot={"type": "spot", "cutoff_angle": 15, "to_world": look},
        off={"type": "point", "position": [0.5, 0, 1], "sampling_weight": 0.0},
    )
    learner = learner_of(scene, grid=8)
    selection = LightTable(
        learner.map.rows, learner.map.cells, learner._probabilities(learner.map.unoccluded)
    )
    lanes = 1 << 12
    si = surface((0.6, 0.1, 0), width=lanes)
    _ds, weight, choice, _state = connect(selection, scene, _sampler(lanes), si)
    assert not weight.numpy().any() and bool(dr.all(choice.probability == 1))


# ---- Weights before anything is learned ----


def test_the_default_of_a_divided_light_is_its_area():
    scene = floor(wide=lamp(0, 0, 1, size=1.0), small=lamp(0, 0, 0.5))
    cells = LightCells(scene, mi.Vector3f(0.5))
    weights = uniform_weights(scene, cells).numpy()
    assert cells.count > 4
    assert np.bincount(cells.emitter_index, weights) == pytest.approx(np.ones(2))


def test_other_points_expect_the_mean_of_all_rows_and_sampling_weights_count():
    lamps = {"a": lamp(0.3, 0, 1), "b": lamp(-0.3, 0, 1)}
    table = map_of(floor(**lamps)).unoccluded.numpy().reshape(-1, 2)
    assert table[-1] == pytest.approx(table[:-1].mean(axis=0), rel=1e-4) and (table[-1] > 0).all()
    lamps["a"]["emitter"]["sampling_weight"] = 3.0
    other = map_of(floor(**lamps)).unoccluded.numpy().reshape(-1, 2)
    # The order of emitters differs from one loading to the next
    assert np.sort(other.sum(axis=0) / other.sum()) == pytest.approx([0.25, 0.75], abs=0.04)


@pytest.mark.parametrize("radiance", [1e-24, 1e21])
def test_expectations_of_extreme_lights_are_numbers(radiance: float):
    scene = floor(a=lamp(0, 0, 1, radiance=radiance), b=lamp(0.5, 0, 1, radiance=radiance))
    light_map = map_of(scene)
    table = light_map.unoccluded.numpy()
    assert np.isfinite(table).all() and (table > 0).all()
    observe(light_map, 0, 100, 0, row_of(light_map, light_map.unoccluded)[0])
    equal = mi.Float(np.full(len(table), 0.5))
    ratios = light_map.square_ratios(equal, equal).numpy()
    assert (ratios == 1).all()


@pytest.mark.parametrize("evaluations, runs", [(1 << 22, 1), (200, 2)])
def test_important_pairs_are_measured_again_and_keep_their_places(evaluations, runs):
    calls = []

    def measure(row, cell, sampler):
        calls.append(dr.width(row))
        return mi.Float(10 * row + cell)

    means = cell_means(10, 5, (2, 16), measure, evaluations).numpy().reshape(10, 5)
    assert np.array_equal(means, 10 * np.arange(10)[:, None] + np.arange(5))
    assert len(calls) == runs


def test_pairs_that_are_all_alike_are_not_measured_again():
    means = cell_means(
        50, 2, (2, 16), lambda row, cell, sampler: dr.full(mi.Float, 1, dr.width(row)), 200
    )
    assert (means.numpy() == 1).all()


# ---- Giving up ----


@pytest.mark.parametrize(
    "wishes, rejects, ends",
    [({}, False, True), ({"grid": 4}, False, False), ({}, True, False)],
)
def test_learning_that_does_not_pay_ends_with_the_choice_of_path_unless_needed(
    wishes, rejects, ends
):
    scene = floor(a=lamp(-0.1, 0, 50), b=lamp(0.1, 0, 50))  # nothing to choose between
    learner = learner_of(scene, **wishes)
    if rejects:
        learner.shadow_test(RejectionLaw("affine", 10.0, 0.1))
    _pilot(learner, as_path=1.0)
    decision = learner.learn(Pilot(scene, False))
    assert (decision is None) == ends
    assert ("as path" in str(learner)) == ends and (learner.map is None) == ends


def test_the_cost_of_a_choice_counts_segments_shadow_rays_and_the_table():
    records = learner_of(floor(a=lamp(-0.1, 0, 50), b=lamp(0.1, 0, 50)))._records
    # Of 10 paths: connections, shadow rays, and shadow rays with Mitsuba's choice
    records._paths, records._rays = 10, np.array([40.0, 30.0, 20.0])
    as_path, table = SEGMENT * (10 + 40) + SHADOW * 20, TABLE * 40
    assert records.cost == pytest.approx((as_path + SHADOW * 10 + table) / as_path)
    assert records.least_cost == pytest.approx((as_path + table) / as_path)


def test_learning_goes_on_where_lights_were_chosen_better_than_by_path():
    """In the second pilot, connections bring a tenth of what they would bring with path's choice,
    ten times as often."""
    scene = floor(a=lamp(-0.1, 0, 50), b=lamp(0.9, 0, 50))
    learner = learner_of(scene)
    learner._is_tested = True  # the first pilot is over
    _pilot(learner, as_path=0.05)
    assert type(learner.learn(Pilot(scene, False))) is LightTable
    assert "less variance" in str(learner._effect)


def _pilot(learner: LightMapLearner, as_path: float) -> None:
    """Paths of which each has one connection, to the first of two lights; Mitsuba would choose it
    with the probability ``as_path`` · 0.5."""
    lanes = 1 << 12
    learner.begin(lanes, dr.zeros(mi.UInt32, lanes))
    if learner._records is not None:
        learner._records._as_path = mi.Float([0.5 * as_path, 1 - 0.5 * as_path])
    si = surface((0.1, 0.1, 0), width=lanes)
    row = learner.map.rows.row(si, mi.Bool(True))
    choice = Choice(row, dr.zeros(mi.UInt32, lanes), dr.full(mi.Float, 0.5, lanes))
    ds = dr.zeros(mi.DirectionSample3f, lanes)
    ds.pdf, ds.delta = mi.Float(1), mi.Bool(True)
    light = mi.Color3f(dr.select(dr.arange(mi.UInt32, lanes) % 2 == 0, mi.Float(2), 0))
    learner.connection(
        choice, vertex_at(0, si), ds, light, light, mi.Float(0), light.x > 0, mi.Bool(True)
    )
    learner.end(light)


def test_smooth_meshes_are_sampled_by_their_triangles_even_where_nothing_is_gained():
    assert not learner_of(floor(a=lamp(0, 0, 1)))._is_needed
    light = {**ball(16, 8, smooth=True), "emitter": {"type": "area"}}
    learner = learner_of(mi.load_dict({"type": "scene", "ball": light}))
    assert learner._is_needed and learner.map is not None
