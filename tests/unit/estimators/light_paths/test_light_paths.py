"""``light_paths``: the number of light paths, and the techniques that pay."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.estimators.light_paths import path_tracer
from mitsuba_ext.estimators.light_paths.choice import light_paths
from mitsuba_ext.estimators.light_paths.choice.candidates import Available, Candidate, candidates
from mitsuba_ext.estimators.light_paths.choice.path_moments import Counts, PathMoments
from mitsuba_ext.estimators.light_paths.merging.merging_radius import MergingRadius
from mitsuba_ext.estimators.light_paths.vertex_choice import Chosen, VertexChoice
from tests.support.bdpt import assert_image_of_path, bdpt
from tests.support.emitters_and_materials import EMITTERS, T, below_the_lamp, stage_with_ball
from tests.support.stage import area, diffuse, lookat, rectangle, rgb, stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_quarters,
    batches,
    load,
    some,
)

pytestmark = pytest.mark.usefixtures("variant")


def _auto(**parameters: Any) -> mi.Integrator:
    return bdpt(**{"max_depth": 6, "light_paths": "auto", "pilot_spp": 16, **parameters})


def test_light_paths_are_kept_where_they_find_caustics() -> None:
    integrator = _auto()
    mi.render(load("caustic", width=48, height=27), integrator=integrator, spp=64)
    assert integrator.statistics.learned.startswith("light paths pay")


def test_passes_are_longer_with_few_light_paths() -> None:
    """Camera paths take little memory."""
    few, one = (bdpt(light_paths=count).sample_bytes.usual for count in (1 / 16, 1.0))
    assert one / 16 < few < one / 5


def test_path_takes_nearly_as_long_where_it_traces_no_shadow_rays() -> None:
    """Light paths with many connections are then no more expensive, relative to ``path``, than the
    vertices of its paths say."""
    many = Candidate(1 / 16, connections=4)
    times = {}
    for tested in (0, 1000):
        counts = Counts(camera_rays=1000, tested=tested, light_rays=800, connected=240)
        of_path = light_paths.cost(Candidate(0.0), counts)
        times[tested] = of_path, light_paths.cost(many, counts) / of_path
    assert times[1000][0] < 1.5 * times[0][0]
    # keyhole, which has no tested shadow rays: 2.7 was measured
    assert times[0][1] == pytest.approx(2.7, rel=0.2)


@pytest.mark.parametrize("ball", [{"type": "diffuse"}, {"type": "conductor"}])
def test_light_paths_are_dropped_under_an_open_sky(ball: dict[str, Any]) -> None:
    """This includes light by way of a mirror, because the rays of ``path`` hit the sky."""
    integrator = _auto()
    scene = {**stage_with_ball(ball), "light": EMITTERS["constant"]()}
    mi.render(mi.load_dict(scene, optimize=False), integrator=integrator, spp=256)
    assert integrator.statistics.learned.startswith("light paths do not pay")


def test_without_lights_there_is_nothing_to_choose() -> None:
    integrator = _auto()
    assert not batches(mi.load_dict(stage(light={})), integrator, 4, [1]).any()
    assert integrator.statistics.learned == ""


@pytest.mark.parametrize("spp, is_kept", [(64, False), (4096, True)])
def test_light_that_path_cannot_find_keeps_light_paths_if_it_exceeds_the_noise(
    spp: int, is_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caustic of a point light, in a render of ``spp`` samples. The trial is told that number;
    the test itself renders fewer."""
    make = light_paths.LightPathTrial.__init__

    def of_length(trial, film, _) -> None:
        make(trial, film, spp)

    monkeypatch.setattr(light_paths.LightPathTrial, "__init__", of_length)
    scene = stage_with_ball({"type": "conductor"})
    scene["light"] = {"type": "point", "position": [0.8, -1, 1.5], "intensity": rgb(1.0)}
    scene["sky"] = {"type": "constant", "radiance": rgb(0.01)}
    integrator = _auto()
    mi.render(mi.load_dict(scene, optimize=False), integrator=integrator, spp=64)
    effect = integrator.statistics.effects["light_paths"]
    assert effect["is_kept"] == is_kept
    assert effect["long_run_variance"] == 0 and 0.01 < effect["missed_by_path"] < 0.1
    assert ("of the light is missing" in integrator.statistics.learned) != is_kept


@pytest.mark.parametrize("light", some("constant", of=["constant", "rectangle"]))
def test_the_choice_does_not_change_the_mean(light: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[light](), camera=below_the_lamp()), optimize=False)
    images = batches(scene, _auto(max_depth=4), 128, SEEDS[:MANY_SEEDS])
    path = mi.load_dict({"type": "path", "max_depth": 4})
    expected = batches(scene, path, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.01)


def _below_a_ceiling(bsdf: dict[str, Any]) -> dict[str, Any]:
    """All light comes by way of the ceiling."""
    down = T().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(30)
    lamp = rectangle(T().translate([-0.3, 0, 2.1]).scale(0.7), bsdf=diffuse(0.0), emitter=area(5.0))
    return stage(light=lamp, camera=below_the_lamp(), ceiling=rectangle(down, bsdf=bsdf))


def assert_variance_of_path_is_predicted(scene: dict[str, Any], **parameters: Any) -> None:
    """From what all techniques find, and measured between seeds of ``path``."""
    scene = mi.load_dict(scene, optimize=False)
    integrator = _auto(max_depth=4, pilot_spp=64, **parameters)
    mi.render(scene, integrator=integrator, spp=512)  # an eighth of them are pilots
    predicted = integrator.learners["light_paths"].estimate.variances[0].mean()
    seeds = batches(scene, mi.load_dict({"type": "path", "max_depth": 4}), 16, range(24))
    measured = 16 * seeds.mean(axis=-1).var(axis=0, ddof=1).mean()
    assert predicted == pytest.approx(measured, rel=0.15)


@pytest.mark.parametrize("name", some("rectangle", of=["rectangle", "constant", "sphere"]))
def test_the_variance_of_path_is_predicted(name: str) -> None:
    assert_variance_of_path_is_predicted(stage(light=EMITTERS[name](), camera=below_the_lamp()))


def test_the_variance_of_path_is_predicted_below_water() -> None:
    """One refraction: densities change by the squared index of refraction."""
    water = rectangle(T().translate([0, 0, 0.9]).scale(30), bsdf={"type": "dielectric"})
    camera = below_the_lamp(to_world=lookat([0, -4, 0.6], [0, 0, 0], [0, 0, 1]))
    light = EMITTERS["rectangle"]()
    assert_variance_of_path_is_predicted(stage(light=light, camera=camera, water=water))


@pytest.mark.parametrize("vertices", [2.5, 8.0])
def test_the_variance_of_path_is_predicted_whatever_weights_connections_have(
    vertices: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All light is indirect, and MIS weights assume this number of vertices of a light path."""
    monkeypatch.setattr(path_tracer, "_VERTICES", vertices)
    assert_variance_of_path_is_predicted(_below_a_ceiling(diffuse()), light_image=False)


@pytest.mark.parametrize("parameters", [
    {"light_paths": 0.25}, {"light_paths": 4.0}, {"connections": 0}, {"connections": 4},
    pytest.param({"light_paths": 0.25, "connections": 0}, marks=pytest.mark.slow),
    pytest.param({"light_paths": 0.25, "connections": 2}, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_variance_of_other_techniques_is_predicted(parameters: dict[str, float]) -> None:
    """From the samples of all of them, with one light path for each camera path."""
    scene = mi.load_dict(_below_a_ceiling(diffuse()), optimize=False)
    integrator = _auto(max_depth=4, pilot_spp=64)
    mi.render(scene, integrator=integrator, spp=256)
    learner = integrator.learners["light_paths"]
    candidate = Candidate(parameters.get("light_paths", 1.0), parameters.get("connections", 1))
    predicted = learner.estimate.variances[learner.candidates.index(candidate)].mean()
    seeds = batches(scene, bdpt(4, **parameters), 16, range(24))
    measured = 16 * seeds.mean(axis=-1).var(axis=0, ddof=1).mean()
    assert predicted == pytest.approx(measured, rel=0.3)


@pytest.mark.parametrize("parameters", [
    {"light_paths": 0.25}, {"light_paths": 4, "connections": 0},
    pytest.param({"light_paths": 0}, marks=pytest.mark.slow),
    pytest.param({"light_paths": 0.1, "connections": 3}, marks=pytest.mark.slow),
    pytest.param({"light_paths": 2, "light_image": False}, marks=pytest.mark.slow),
])  # fmt: skip
def test_the_number_of_light_paths_does_not_change_the_mean(parameters: dict[str, Any]) -> None:
    camera = {**below_the_lamp(), "type": "thinlens", "aperture_radius": 0.1, "focus_distance": 3}
    assert_image_of_path(stage(camera=camera), **parameters)


def test_several_connections_are_tried_where_light_paths_are_shared_and_not_merged() -> None:
    radius = MergingRadius(0.1, 0.75, 100, 0.01)
    shared = candidates(Available(True, True, radius, are_shared=True))
    several = [c for c in shared if c.connections > 1]
    assert {c.connections for c in several} == {2, 4}
    assert not any(c.merges for c in several)
    own = candidates(Available(True, True, None, are_shared=False))
    assert {c.connections for c in own} == {0, 1}


@pytest.mark.slow
def test_light_paths_pay_behind_glass_and_merging_where_light_is_seen_through_water() -> None:
    """In glass_lamp, where nothing shows the light through glass, merging gains little."""
    integrator = mi.load_dict(
        {"type": "vcm", "max_depth": 6, "light_paths": "auto", "pilot_spp": 16}
    )
    mi.render(load("glass_lamp", width=48, height=27), integrator=integrator, spp=64)
    assert "light paths pay" in integrator.statistics.learned
    mi.render(load("pool", width=48, height=27), integrator=integrator, spp=64)
    assert "merging" in integrator.statistics.learned


@pytest.mark.parametrize("count", [-1, 65, "many", True])
def test_a_wrong_number_of_light_paths_is_refused(count: Any) -> None:
    with pytest.raises(RuntimeError, match='"light_paths" is .* or a number from 0 to 64'):
        bdpt(light_paths=count)


def test_spectral_light_paths_are_as_many_as_camera_paths() -> None:
    mi.set_variant("llvm_ad_spectral")
    with pytest.raises(NotImplementedError, match='"light_paths" is 0.25; in spectral variants'):
        bdpt(light_paths=0.25).render(mi.load_dict(stage()), spp=1)


def test_a_restored_choice_needs_no_pilot(tmp_path) -> None:
    file = str(tmp_path / "learned.npz")
    scene = mi.load_dict(stage(light=EMITTERS["constant"](), camera=below_the_lamp()))
    mi.render(scene, integrator=_auto(save_learned=file), spp=256)
    restored = _auto(load_learned=file)
    mi.render(scene, integrator=restored, spp=4)
    assert restored.statistics.learned == "light paths do not pay"


# ---- What light paths know of camera paths ----


#: Paths that are found with s vertices by light paths, and in no other way but by camera paths
#: alone: s, the scene, and parameters. Without a light image, t is 2.
ALONE = {
    "splats": (2, lambda: stage(camera=below_the_lamp()), {"max_depth": 2}),
    "connections": (2, lambda: stage(camera=below_the_lamp()),
                    {"max_depth": 3, "light_image": False}),
    "splats by a mirror": (3, lambda: _below_a_ceiling({"type": "conductor"}), {"max_depth": 3}),
    "connections by a mirror": (3, lambda: _below_a_ceiling({"type": "conductor"}),
                                {"max_depth": 4, "light_image": False}),
}  # fmt: skip


@pytest.mark.parametrize("name", ALONE)
def test_weights_follow_from_the_densities_that_light_paths_know(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where camera paths alone are the only other techniques, and the number of vertices of a light
    path is the one that weights assume."""
    length, scene, parameters = ALONE[name]
    counts = []

    class Recorder(PathMoments):
        """Counts paths, by whether the weight is the expected one."""

        def start(self, rays, available) -> None:
            super().start(rays, available)
            self.count = dr.zeros(mi.UInt32, 2)
            dr.eval(self.count)
            counts.append(self.count)

        def joined(self, s, t, value, mis, competing, active) -> None:
            self._compare(s, mis, competing, active)
            super().joined(s, t, value, mis, competing, active)

        def splatted(self, s, position, value, mis, competing, active) -> None:
            self._compare(s, mis, competing, active)
            super().splatted(s, position, value, mis, competing, active)

        def _compare(self, s, mis, competing, active) -> None:
            error = dr.abs(mis * (1 + dr.squared_norm(competing.by_camera)) - 1)
            index = dr.select((s == length) & (error < 2e-3), mi.UInt32(0), 1)
            dr.scatter_add(self.count, mi.UInt32(1), index, active & (mis < 0.99))

    choose = VertexChoice.choose

    def as_assumed(self, *arguments) -> Chosen:
        return replace(choose(self, *arguments), factor=mi.Float(path_tracer._VERTICES))

    monkeypatch.setattr(VertexChoice, "choose", as_assumed)
    monkeypatch.setattr(light_paths, "PathMoments", Recorder)
    integrator = _auto(pilot_spp=64, **parameters)
    mi.render(mi.load_dict(scene(), optimize=False), integrator=integrator, spp=256)
    right, wrong = (sum(int(count[i]) for count in counts) for i in (0, 1))
    assert right > 100 and wrong < 1e-3 * right
