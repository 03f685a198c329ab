"""Guided directions: unbiased, better where light is hidden, and absent where nothing is gained."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from statistical import REFERENCE_SEEDS, SEEDS, assert_same_mean, batches, load

from mitsuba_ext.decisions import guide_learner

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def forced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guides, whatever it brings."""
    monkeypatch.setattr(guide_learner, "_LEAST_EFFICIENCY", -1.0)


def _integrator(max_depth: int = 4, **parameters) -> mi.Integrator:
    return mi.load_dict({"type": "pss_guided", "max_depth": max_depth, **parameters})


@pytest.mark.parametrize(
    ("regions", "bounces", "connects"),
    [("surfaces", 1, False), ("surfaces", 4, True), ("tiles", 2, True), ("tiles", 4, False)],
)
def test_guided_paths_have_the_mean_of_path(
    forced: None, regions: str, bounces: int, connects: bool
) -> None:
    """With and without connections from the first vertex; the film divides into no whole tiles."""
    parameters = {"regions": regions, "bounces": bounces, "nee_first_bounce": connects}
    if regions == "tiles":
        parameters["tile"] = 8
    integrator = _integrator(6, **parameters)
    scene = load("door_ajar", width=33, height=19)
    images = batches(scene, integrator, 128, SEEDS)
    assert integrator.guide is not None
    path = mi.load_dict({"type": "path", "max_depth": 6})
    assert_same_mean(images, batches(scene, path, 128, REFERENCE_SEEDS), precision=0.03)


def test_what_is_learned_lowers_the_variance_where_light_comes_through_a_gap() -> None:
    scene = load("door_ajar", width=64, height=36)
    guided, path = (
        batches(scene, integrator, 64, SEEDS[:8])
        for integrator in (_integrator(6), mi.load_dict({"type": "path", "max_depth": 6}))
    )
    ratio = np.median(guided.var(axis=0)) / np.median(path.var(axis=0))
    assert ratio < 0.9, ratio


def test_nothing_is_guided_where_nothing_is_gained() -> None:
    integrator = _integrator(2)
    mi.render(load("furnace_convex", width=32, height=32), integrator=integrator, spp=32)
    assert integrator.guide is None
    assert integrator.statistics.learned.startswith("no guide")


def test_without_connections_from_the_first_vertex_no_shadow_ray_is_traced() -> None:
    integrator = _integrator(2, nee_first_bounce=False)
    image = mi.render(load("cornell_box", width=16, height=16), integrator=integrator, spp=32)
    assert integrator.statistics.rays["shadow"] == 0
    assert np.array(image).any()


def test_same_seed_gives_the_same_image_whatever_was_rendered_before() -> None:
    scene, integrator = load("door_ajar", width=33, height=19), _integrator(6)
    first = np.array(mi.render(scene, integrator=integrator, spp=32, seed=3))
    mi.render(load("cornell_box", width=16, height=16), integrator=integrator, spp=16)
    again = np.array(mi.render(scene, integrator=integrator, spp=32, seed=3))
    np.testing.assert_allclose(again, first, rtol=1e-4, atol=1e-5 * first.mean())


def test_little_memory_records_a_part_of_the_paths(forced: None) -> None:
    scene, learned = load("door_ajar", width=32, height=18), []
    for max_memory in (512.0, 0.25):
        integrator = _integrator(4, max_memory=max_memory)
        mi.render(scene, integrator=integrator, spp=64)
        learned.append(int(integrator.statistics.learned.split(" samples")[0].split()[-1]))
    assert 0 < learned[1] < 0.25 * learned[0]


@pytest.mark.parametrize("spp", [1, 2, 11])
def test_too_few_samples_are_those_of_path(spp: int) -> None:
    scene = load("cornell_box", width=17, height=11)
    image, path = (
        np.array(mi.render(scene, integrator=integrator, spp=spp, seed=1))
        for integrator in (_integrator(4), mi.load_dict({"type": "path", "max_depth": 4}))
    )
    np.testing.assert_allclose(image, path, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"regions": "walls"}, 'regions.*one of surfaces, tiles'),
        ({"bounces": 0}, "bounces.*at least 1"),
        ({"regions": "tiles", "bounces": 6}, "bounces.*at most 5"),
        ({"tile": 8}, "tile"),
        ({"pilot_spp": -1}, "pilot_spp.*at least 0"),
    ],
)
def test_wrong_parameters_are_refused(parameters: dict, message: str) -> None:
    with pytest.raises(Exception, match=message):
        _integrator(**parameters)
