"""Connections through casters where pilots show that they pay."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.manifolds.parameters import LearnedManifold
from mitsuba_ext.planning import verdicts
from mitsuba_ext.planning.learner import Pilot
from mitsuba_ext.planning.technique import Setting

pytestmark = pytest.mark.usefixtures("variant")


def _scene(**things) -> mi.Scene:
    """A floor under a small lamp."""
    transform = mi.ScalarTransform4f()
    lamp = {"type": "sphere", "center": [0, 0, 4], "radius": 0.05,
            "emitter": {"type": "area", "radiance": 400.0}}  # fmt: skip
    camera = {
        "type": "perspective", "fov": 40,
        "to_world": transform.look_at(origin=[0, -4, 3], target=[0, 0, 0], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
    }
    floor = {"type": "rectangle", "to_world": transform.scale(3)}
    return mi.load_dict({
        "type": "scene", "camera": camera, "floor": floor, "lamp": lamp, **things
    })


_BALL = {"type": "sphere", "center": [0, 0, 1], "radius": 0.5, "bsdf": {"type": "dielectric"}}


def test_nothing_is_tried_without_casters_or_under_a_uniform_sky() -> None:
    technique = LearnedManifold()
    assert technique.can_learn(_scene(ball=_BALL), 8)
    assert not technique.can_learn(_scene(), 8)
    sky = {"type": "scene", "ball": _BALL, "sky": {"type": "constant"}}
    assert not technique.can_learn(mi.load_dict(sky), 8)


def test_short_renders_connect_nothing() -> None:
    scene = _scene(ball=_BALL)
    setting = Setting(scene, scene.sensors()[0], 0, 6, 5, spp=32, pilot_spp=8)
    learner = LearnedManifold().learner(setting, {})
    assert learner.start(scene, mi.Point3f(), mi.Normal3f()) is None
    assert learner.learn(Pilot(scene, True)) is None and learner.effect is None
    assert not (str(learner) or learner.state())


@pytest.mark.slow
def test_connections_that_pay_are_used_and_change_no_mean(monkeypatch) -> None:
    monkeypatch.setattr(verdicts, "LEAST_CAUSTIC_SAMPLES", 1)
    monkeypatch.setattr(verdicts, "SAMPLES_PER_CASTER", 1)
    scene = _scene(ball=_BALL)
    integrator = mi.load_dict({
        "type": "auto_path", "caustics": "automatic", "max_depth": 6, "pilot_spp": 8,
    })  # fmt: skip
    images = [np.array(integrator.render(scene, spp=256, seed=i)).mean() for i in range(24)]
    assert integrator.statistics.effects["caustics"]["is_kept"]
    assert integrator.statistics.effects["caustics"]["variance"] < 0.3
    path = mi.load_dict({"type": "path", "max_depth": 6})
    others = [
        np.array(mi.render(scene, integrator=path, spp=1024, seed=100 + i)).mean()
        for i in range(24)
    ]
    error = np.hypot(*(np.std(x, ddof=1) / np.sqrt(24) for x in (images, others)))
    assert abs(np.mean(images) - np.mean(others)) < 4 * error
