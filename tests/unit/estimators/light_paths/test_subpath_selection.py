"""``bdpt`` with ``subpath_selection`` chooses light vertices by weights that pilots have
learned."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2

from mitsuba_ext.estimators.light_paths.bidirectional_programs import LightSums
from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.light_vertices import VertexCache
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums, Sums
from mitsuba_ext.estimators.light_paths.subpath_choice.region_table import RegionTable
from mitsuba_ext.estimators.light_paths.vertex_choice import RegionChoice
from mitsuba_ext.planning import verdicts
from mitsuba_ext.scene.regions.nested_regions import NestedRegions
from mitsuba_ext.scene.regions.surface_voxels import lit_normal
from mitsuba_ext.transport.path_decisions import EmitterSampling
from mitsuba_ext.transport.vertex import Arrival, PathState, Vertex
from tests.support.bdpt import assert_image_of_path, bdpt
from tests.support.emitters_and_materials import T, below_the_lamp
from tests.support.stage import area, diffuse, film, rectangle, sensor, stage
from tests.support.statistical import SEEDS, batches, load, some

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learning goes on also where it does not pay."""
    monkeypatch.setattr(verdicts, "pays", lambda *_: True)


def wall() -> dict[str, Any]:
    """A thin wall that keeps the lamp's light from a half of the stage."""
    return rectangle(T().translate([0.2, 0, 0.5]).rotate([0, 1, 0], 80).scale([0.7, 2, 1]),
                     bsdf={"type": "twosided", "bsdf": diffuse(0.6)})  # fmt: skip


# ---- The image ----

SCENES = {
    "wall": lambda: stage(camera=below_the_lamp(), wall=wall()),
    "sky": lambda: stage(camera=below_the_lamp(), wall=wall(), sky={"type": "constant"}),
    "rough glass": lambda: stage(
        camera=below_the_lamp(),
        pane=rectangle(T().translate([0, 0, 0.9]).rotate([1, 0, 0], 25),
                       bsdf={"type": "roughdielectric", "alpha": 0.3}),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", some("wall", of=SCENES))
def test_the_image_agrees_with_path(name: str, always: None) -> None:
    assert_image_of_path(SCENES[name](), precision=0.01, subpath_selection="visibility")


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [
    {"connections": 3}, {"light_image": False}, {"next_event": "contribution"},
    {"directions": "guided"},
], ids=str)  # fmt: skip
def test_it_goes_with_other_decisions(parameters: dict[str, Any], always: None) -> None:
    scene = stage(camera=below_the_lamp(), wall=wall(), sky={"type": "constant"})
    assert_image_of_path(scene, subpath_selection="visibility", **parameters)


@pytest.mark.slow
def test_light_around_corners_has_less_variance() -> None:
    scene = load("corridor", width=64, height=36, max_depth=8)
    uniform, learned = (
        batches(scene, bdpt(8, **parameters), 64, SEEDS[:4])
        for parameters in ({}, {"subpath_selection": "visibility"})
    )
    mean = uniform.mean(axis=0).mean()
    before, after = (
        np.mean(np.sort(images.var(axis=0, ddof=1).ravel())[:-20]) / mean**2
        for images in (uniform, learned)
    )
    assert after < 0.7 * before


def test_learning_ends_where_it_would_not_pay() -> None:
    scene = load("caustic", width=32, height=18, max_depth=6)
    integrator = bdpt(6, subpath_selection="visibility")
    batches(scene, integrator, 64, [1])
    assert "uniformly chosen" in integrator.statistics.learned


def test_uniform_is_the_default() -> None:
    scene = mi.load_dict(stage(camera=below_the_lamp()))
    default, uniform = (
        batches(scene, bdpt(**p), 16, [3])[0] for p in ({}, {"subpath_selection": "uniform"})
    )
    np.testing.assert_allclose(default, uniform, rtol=1e-4, atol=1e-5 * default.mean())


def test_the_same_seed_gives_the_same_image(always: None) -> None:
    scene = mi.load_dict(stage(camera=below_the_lamp(), wall=wall()))
    images = [
        batches(scene, bdpt(subpath_selection="visibility"), 32, [7])[0] for _ in range(2)
    ]
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-5 * images[0].mean())


# ---- Where there is little or nothing to learn ----

FEW = {
    "no light": lambda: stage(light={}),
    "light that reaches nothing": lambda: stage(
        light=rectangle(T().translate([0, 0, 3]), emitter=area(5.0))
    ),
    "one pixel": lambda: stage(camera=sensor(film=film(1, 1))),
    "nothing but a lamp": lambda: {
        "type": "scene", "integrator": {"type": "path"}, "sensor": sensor(),
        "lamp": {"type": "sphere", "radius": 0.3, "emitter": area(1.0)},
    },
}  # fmt: skip


@pytest.mark.parametrize("max_depth", [1, 2, 3])
@pytest.mark.parametrize("name", FEW)
def test_little_to_learn_is_no_error(name: str, max_depth: int, always: None) -> None:
    integrator = bdpt(max_depth, subpath_selection="visibility")
    assert np.isfinite(batches(mi.load_dict(FEW[name]()), integrator, 16, [1])).all()


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_where_light_paths_are_not_shared_nothing_is_learned(variant: str) -> None:
    integrator = bdpt(subpath_selection="visibility")
    assert np.isfinite(batches(mi.load_dict(stage()), integrator, 16, [1])).all()
    assert not integrator.learners


def test_the_learned_selection_is_restored(tmp_path, always: None) -> None:
    scene, file = mi.load_dict(stage(camera=below_the_lamp(), wall=wall())), tmp_path / "learned"
    saves = bdpt(subpath_selection="visibility", save_learned=str(file))
    saved = batches(scene, saves, 64, [3])[0]
    loads = bdpt(subpath_selection="visibility", load_learned=str(file))
    loaded = batches(scene, loads, 64, [4])[0]
    np.testing.assert_allclose(loaded.mean(), saved.mean(), rtol=0.05)
    assert "regions" in loads.statistics.learned


# ---- The choice ----


def _table_and_vertices(adversarial: bool) -> tuple[RegionTable, VertexCache]:
    scene = mi.load_dict(stage(camera=below_the_lamp(), wall=wall()))
    lanes = 4096
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(1, lanes)

    def vertices(selection: RegionTable | None) -> VertexCache:
        program = LightSums(PartialSums(selection=selection), EmitterSampling())
        walk = LightWalk(LightEmission(scene), 5, 5, program)
        active = dr.full(mi.Bool, True, lanes)
        return walk.run(scene, numbers, mi.Float(0), mi.Ray3f().wavelengths, active)[0]

    some_vertices = vertices(None)
    active = dr.full(mi.Bool, True, some_vertices.count)
    vertex = some_vertices.at(dr.arange(mi.UInt32, some_vertices.count), active)
    si = vertex.si
    regions = NestedRegions(si.p, lit_normal(si), most=12)
    rng = np.random.default_rng(2)
    probability = rng.uniform(0.1, 1, (regions.count, regions.count))
    if adversarial:
        # Nearly all in one region, and the last one without any vertex
        probability[:, 1] = 1e5
    probability /= probability.sum(axis=1, keepdims=True)
    table = RegionTable(regions, probability, np.full(regions.count, 0.3))
    return table, vertices(table)


@pytest.mark.parametrize("adversarial", [False, True])
def test_vertices_are_chosen_as_often_as_their_weights_say(adversarial: bool) -> None:
    table, vertices = _table_and_vertices(adversarial)
    choice, draws, camera_region = RegionChoice(vertices, table), 1 << 20, 2
    numbers = mi.PCG32(size=draws)
    path = PathState(
        mi.Spectrum(1), mi.Float(1), mi.Float(1), mi.UInt32(0),
        Arrival(dr.zeros(mi.Interaction3f), mi.Float(1), mi.Bool(True)), None,
        Sums(mi.Float(0), mi.Float(0), region=dr.full(mi.UInt32, camera_region, draws)),
    )  # fmt: skip
    vertex = Vertex(dr.zeros(mi.SurfaceInteraction3f, draws), None, path)
    pairs = [mi.Point2f(numbers.next_float32(), numbers.next_float32()) for _ in range(2)]
    chosen = choice.choose(tuple(pairs), vertex, mi.Bool(True))
    index, active = chosen.index.numpy(), chosen.active.numpy()
    lanes = vertices.paths
    probability = 1 / (chosen.factor.numpy() * lanes)
    each = np.zeros(vertices.count)
    each[index[active]] = probability[active]
    seen = np.bincount(index[active], minlength=vertices.count)
    # Vertices of the same probability together: by regions
    region = vertices.region.numpy()
    np.testing.assert_array_equal(region[index[active]], chosen.region.numpy()[active])
    by_region = np.bincount(region, seen, table.count)
    counts = np.bincount(region, minlength=table.count)
    expected = draws * np.array([each[region == r].max(initial=0) for r in range(table.count)])
    expected *= counts
    large = expected > 5
    statistic = ((by_region - expected)[large] ** 2 / expected[large]).sum()
    assert chi2.sf(statistic, large.sum()) > 1e-4
    # And uniformly within the largest
    largest = seen[region == by_region.argmax()]
    statistic = ((largest - largest.mean()) ** 2 / largest.mean()).sum()
    assert 1e-4 < chi2.sf(statistic, len(largest) - 1)
    # What MIS weights are told is the probability of the region, per vertex that is expected there
    told = chosen.expected.numpy()[active] * 0.3 * lanes
    np.testing.assert_allclose(told, probability[active] * counts[region[index[active]]] * lanes,
                               rtol=1e-4)  # fmt: skip
