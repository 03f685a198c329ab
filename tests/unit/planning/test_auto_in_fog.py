"""``auto`` renders fog by photons where these pay."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice import photon_trial
from mitsuba_ext.estimators.light_paths.choice.photon_trial import PhotonTrial
from mitsuba_ext.planning import verdicts
from mitsuba_ext.planning.prediction_check import PredictionCheck
from mitsuba_ext.planning.trial import Rival
from mitsuba_ext.rendering.pass_images import FEWEST_PASSES
from tests.support.fogs import cube, fog, homogeneous
from tests.support.stage import area, lookat

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(autouse=True)
def small_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    monkeypatch.setattr(photon_trial, "_LEAST", 1 << 14)
    monkeypatch.setattr(photon_trial, "_SAMPLES", 1 << 11)


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


def test_photons_render_light_that_camera_paths_miss(tmp_path) -> None:
    scene, file = mi.load_dict(beam_through_glass()), str(tmp_path / "learned.npz")
    auto = make(save_learned=file)
    found = image(auto, scene)
    effect = auto.statistics.effects["light_paths"]
    assert "photons pay" in auto.statistics.learned and effect["is_kept"]
    assert list(auto.statistics.effects) == ["light_paths"]
    expected = image(make("sppm"), scene, 256)
    assert found.mean() == pytest.approx(expected.mean(), rel=0.1)
    again = make(load_learned=file)
    assert image(again, scene, 16).mean() == pytest.approx(expected.mean(), rel=0.1)
    assert again.statistics.learned.endswith("photons pay")


def test_photons_replace_camera_paths_of_more_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    def failed(check: PredictionCheck, time: float, rival: float) -> bool:
        assert check.images.count >= FEWEST_PASSES and time < 1 and rival < 1
        check.variance = 100.0
        return True

    monkeypatch.setattr(verdicts, "is_worth", lambda *_: False)
    monkeypatch.setattr(PredictionCheck, "failed", failed)
    scene, auto = mi.load_dict(beam_through_glass()), make()
    found = image(auto, scene)
    effect = auto.statistics.effects["light_paths"]
    assert "photons pay" in auto.statistics.learned and effect["is_kept"]
    assert list(auto.statistics.effects) == ["light_paths"]
    assert effect["measured_variance"] == pytest.approx(100 * effect["variance"], rel=0.01)
    # The pilots, which miss this light, are not part of the image
    assert found.mean() == pytest.approx(image(make("sppm"), scene, 256).mean(), rel=0.1)


def test_photons_estimate_the_second_moment_of_camera_paths_that_hit_lamps_in_glass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    glass, air = (
        {"type": "sphere", "center": [0, 0.4, 0], "radius": radius,
         "bsdf": {"type": "dielectric", "int_ior": inside, "ext_ior": outside}}
        for radius, inside, outside in ((0.3, 1.5, 1.0), (0.28, 1.0, 1.5))
    )  # fmt: skip
    glass["exterior"] = {"type": "ref", "id": "around"}
    lamp = {"type": "sphere", "center": [0, 0.4, 0], "radius": 0.15, "emitter": area(18.0)}
    scene = mi.load_dict({
        "type": "scene", "around": {**homogeneous(), "id": "around"}, **fog(), "light": lamp,
        "fog": cube({"type": "ref", "id": "around"}), "glass": glass, "air": air,
    }, optimize=False)  # fmt: skip
    moments, choose = [], PhotonTrial.choose

    def chosen(trial: PhotonTrial, rival: Rival) -> Any:
        path = np.concatenate(trial._path.passes)
        moments.append((trial._hidden(), np.mean(path**2, axis=0)))
        return choose(trial, rival)

    monkeypatch.setattr(PhotonTrial, "choose", chosen)
    monkeypatch.setattr(photon_trial, "_PATH_PASSES", 64)
    image(make(), scene)
    hidden, found = (values.reshape(16, 16) for values in moments[0])
    # Beside the lamp, which the camera sees
    np.testing.assert_allclose(hidden[10:].sum(), found[10:].sum(), rtol=0.3)


def test_camera_paths_render_fog_that_they_find_lit() -> None:
    scene = mi.load_dict(fog("area"))
    auto, auto_path = make(), make("auto_path")
    # Passes of pilots differ
    assert image(auto, scene).mean() == pytest.approx(image(auto_path, scene).mean(), rel=0.02)
    assert "photons do not pay" in auto.statistics.learned
    effect = auto.statistics.effects["light_paths"]
    assert not effect["is_kept"] and effect["variance"] * effect["time"] > 1
    assert 0 < effect["measured_variance"] < effect["variance"] * effect["time"]
