"""``auto`` in fog: light paths, connections, merging and photons are candidates."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice import light_paths, photon_samples
from mitsuba_ext.estimators.light_paths.choice.candidate_moments import CandidateMoments
from mitsuba_ext.estimators.light_paths.choice.candidates import Candidate
from mitsuba_ext.estimators.light_paths.choice.light_paths import LightPathChoice, LightPathTrial
from mitsuba_ext.estimators.light_paths.choice.photon_samples import PHOTONS
from mitsuba_ext.estimators.light_paths.partial_sums import CompetingDensities
from mitsuba_ext.planning import planner, verdicts
from mitsuba_ext.planning.prediction_check import PredictionCheck
from mitsuba_ext.planning.trial import Rival
from mitsuba_ext.rendering.request import Request
from tests.support.fogs import LIGHTS, SCENES, camera, fog, homogeneous, without_boundary
from tests.support.stage import area, lookat
from tests.support.statistical import assert_same_quarters, batches

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(autouse=True)
def small_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    # Although renders are short
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    monkeypatch.setattr(planner, "LIGHT_PATH_KERNELS", 0.0)
    monkeypatch.setattr(photon_samples, "_LEAST", 1 << 14)
    monkeypatch.setattr(light_paths, "_SPARSE", 1 << 11)
    monkeypatch.setattr(light_paths, "_MOST", 1.0)
    monkeypatch.setattr(light_paths, "_MOST_IN_MEDIA", 1.0)


def make(name: str = "auto", **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": name, "max_depth": 5, **parameters})


def beam_through_glass() -> dict:
    """Light of a spot light, which no camera path finds behind the glass."""
    ball = {"type": "sphere", "center": [0, 1.4, 0], "radius": 0.35, "bsdf": {"type": "dielectric"}}
    spot = {"type": "spot", "cutoff_angle": 10.0, "intensity": 50.0,
            "to_world": lookat([0, 3, 0], [0, 1, 0], [1, 0, 0])}  # fmt: skip
    return fog() | {"light": spot, "ball": ball}


def image(integrator: mi.Integrator, scene: mi.Scene, spp: int = 64, seed: int = 1) -> np.ndarray:
    return np.array(integrator.render(scene, spp=spp, seed=seed))


def use(monkeypatch: pytest.MonkeyPatch, wanted: Candidate) -> list[LightPathTrial]:
    """Makes all trials choose the same candidate. Returns a list that will hold these trials."""
    trials, choose = [], LightPathTrial.choose

    def chosen(trial: LightPathTrial, rival: Rival) -> LightPathChoice:
        choose(trial, rival)
        trials.append(trial)
        trial._best = trial.candidates.index(wanted)
        trial._choice = LightPathChoice(wanted)
        trial.check = PredictionCheck(trial._film, trial._coarse, trial.predicted.of_path)
        return trial._choice

    monkeypatch.setattr(LightPathTrial, "choose", chosen)
    monkeypatch.setattr(PredictionCheck, "failed", lambda *_: False)
    return trials


def test_light_that_camera_paths_miss_is_rendered(tmp_path) -> None:
    scene, file = mi.load_dict(beam_through_glass()), str(tmp_path / "learned.npz")
    auto = make(save_learned=file)
    found = image(auto, scene)
    effect = auto.statistics.effects["light_paths"]
    assert "light paths pay: " in auto.statistics.learned and effect["is_kept"]
    assert effect["missed_by_path"] > 0.5
    expected = image(make("bdpt"), scene, 256)
    assert found.mean() == pytest.approx(expected.mean(), rel=0.1)
    again = make(load_learned=file)
    assert image(again, scene, 16).mean() == pytest.approx(expected.mean(), rel=0.1)
    assert "light paths pay: " in again.statistics.learned


def test_a_choice_of_photons_leaves_nothing_to_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, PHOTONS)
    scene, auto = mi.load_dict(beam_through_glass()), make()
    found = image(auto, scene)
    assert list(auto.statistics.effects) == ["light_paths"]
    assert "light paths pay: photons" in auto.statistics.learned
    assert found.mean() == pytest.approx(image(make("sppm"), scene, 256).mean(), rel=0.1)


def test_camera_paths_render_fog_that_they_find_lit() -> None:
    auto = make()
    image(auto, mi.load_dict(fog("area")))
    assert "light paths do not pay" in auto.statistics.learned
    effect = auto.statistics.effects["light_paths"]
    assert not effect["is_kept"] and effect["variance"] * effect["time"] > 1


def test_merging_tells_the_variance_of_camera_paths_that_hit_a_lamp_behind_glass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Light scatters once in a ball of smooth glass, and no connection passes its surface."""

    def milk(albedo: float) -> mi.Scene:
        ball = {"type": "sphere", "radius": 1.5, "bsdf": {"type": "dielectric"},
                "interior": homogeneous(0.5, albedo, 0.0)}  # fmt: skip
        lamp = {"type": "sphere", "center": [0, 6, 0], "radius": 2.0, "emitter": area(5.0)}
        return mi.load_dict({"type": "scene", "sensor": camera(), "ball": ball, "light": lamp})

    monkeypatch.setattr(light_paths, "_SPARSE", 1 << 14)
    trials = use(monkeypatch, Candidate(0.0))
    nested = {"type": "volpath", "max_depth": 4}
    found, expected = [], []
    for albedo in (0.8, 0.0):  # the second without scattered light
        scene = milk(albedo)
        image(make(max_depth=4), scene)
        estimate = trials[-1].estimate
        found.append(estimate.variances[0].sum() + (estimate.mean**2).sum())
        moment = mi.load_dict({"type": "moment", "nested": nested})
        expected.append(image(moment, scene, 1024)[..., -3:].mean(axis=2).sum())
    assert found[0] - found[1] == pytest.approx(expected[0] - expected[1], rel=0.1)


def test_photons_of_a_camera_path_count_together() -> None:
    """Two photons, which connections find too: these have three quarters of the weight."""
    merging = [Candidate(1.0, merges=True), Candidate(1.0, connections=0, merges=True)]
    moments = CandidateMoments([Candidate(0.0), *merging], 1, None, 2, 1, None)
    lane, competing = mi.UInt32(0, 1), CompetingDensities(mi.Vector2f(0), mi.Vector2f(3, 0))
    for brought in (1, 2):
        moments.add(
            mi.Float(brought, 0), mi.Float(1 / 4), competing, mi.UInt32(0, 0), lane,
            mi.Bool(True), merging=mi.Float(1), lane=lane,
        )  # fmt: skip
    found = moments.merged(2)
    np.testing.assert_allclose(found[:, 0], [[3, 5], [12, 80]])
    assert not found[:, 1].any()


#: Scenes, and what renders them.
CHOICES = [
    ("lamp_inside", Candidate(1 / 4, connections=2)),
    ("around_the_camera", Candidate(1.0)),
    ("around_the_camera", Candidate(1.0, connections=0, merges=True)),
    ("grid", Candidate(1 / 16, connections=4)),
    ("sky", Candidate(4.0, connections=0)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "choice"), CHOICES)
def test_no_choice_changes_the_mean(
    name: str, choice: Candidate, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, choice)
    scene = mi.load_dict(SCENES[name](), optimize=False)
    images = batches(scene, make(), 256, range(1, 9))
    expected = batches(scene, make("volpath"), 1024, range(1001, 1009))
    assert_same_quarters(images, expected, 0.02)


def test_light_paths_that_cannot_begin_are_no_candidate() -> None:
    """Light from infinity, through fog without a boundary."""
    plans = []
    for light in ("area_inside", "environment"):
        scene = mi.load_dict(without_boundary() | {"light": LIGHTS[light]})
        plans.append(make().plan_learning(Request(scene, scene.sensors()[0]), 64))
    assert [bool(plan.trial) for plan in plans] == [True, False]
    assert plans[0].pilots == plans[1].pilots
