"""``bdpt`` with ``light_paths = auto``."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import pytest
from hard_cases import rgb, stage
from statistical import REFERENCE_SEEDS, SEEDS, assert_same_quarters, batches, load, some
from test_bdpt import bdpt
from test_light_tracer import EMITTERS, MANY_SEEDS, _balls, below_the_lamp

pytestmark = pytest.mark.usefixtures("variant")


def _auto(**parameters: Any) -> mi.Integrator:
    return bdpt(**{"max_depth": 6, "light_paths": "auto", "pilot_spp": 16, **parameters})


def test_light_paths_are_kept_where_they_find_caustics() -> None:
    integrator = _auto()
    mi.render(load("caustic", width=48, height=27), integrator=integrator, spp=64)
    assert integrator.statistics.learned.startswith("light paths pay")


@pytest.mark.parametrize("ball", [{"type": "diffuse"}, {"type": "conductor"}])
def test_light_paths_are_dropped_under_an_open_sky(ball: dict[str, Any]) -> None:
    """Also where some light comes by way of a mirror: ``path`` runs into the sky."""
    integrator = _auto()
    scene = {**_balls(ball), "light": EMITTERS["constant"]()}
    mi.render(mi.load_dict(scene, optimize=False), integrator=integrator, spp=256)
    assert integrator.statistics.learned.startswith("light paths do not pay")


def test_without_lights_there_is_nothing_to_choose() -> None:
    integrator = _auto()
    assert not batches(mi.load_dict(stage(light={})), integrator, 4, [1]).any()
    assert integrator.statistics.learned == ""


def test_light_that_path_cannot_find_keeps_light_paths() -> None:
    """A caustic of a point: one splat of it is enough."""
    scene = _balls({"type": "conductor"})
    scene["light"] = {"type": "point", "position": [0.8, -1, 1.5], "intensity": rgb(1.0)}
    scene["sky"] = {"type": "constant", "radiance": rgb(100.0)}
    integrator = _auto()
    mi.render(mi.load_dict(scene, optimize=False), integrator=integrator, spp=64)
    assert integrator.statistics.learned.startswith("light paths pay (0.00")


@pytest.mark.parametrize("light", some("constant", of=["constant", "rectangle"]))
def test_the_choice_does_not_change_the_mean(light: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[light](), camera=below_the_lamp()), optimize=False)
    images = batches(scene, _auto(max_depth=4), 128, SEEDS[:MANY_SEEDS])
    path = mi.load_dict({"type": "path", "max_depth": 4})
    expected = batches(scene, path, 512, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.01)


@pytest.mark.parametrize("name", some("rectangle", of=["rectangle", "constant", "sphere"]))
def test_the_variance_of_path_is_predicted(name: str) -> None:
    """From what all techniques find, and measured between seeds of ``path``."""
    scene = mi.load_dict(stage(light=EMITTERS[name](), camera=below_the_lamp()), optimize=False)
    integrator = _auto(max_depth=4, pilot_spp=64)
    mi.render(scene, integrator=integrator, spp=256)
    predicted = integrator.learners["light_paths"].estimate.by_camera.mean()
    seeds = batches(scene, mi.load_dict({"type": "path", "max_depth": 4}), 16, range(24))
    measured = 16 * seeds.mean(axis=-1).var(axis=0, ddof=1).mean()
    assert predicted == pytest.approx(measured, rel=0.15)


def test_a_restored_choice_needs_no_pilot(tmp_path) -> None:
    file = str(tmp_path / "learned.npz")
    scene = mi.load_dict(stage(light=EMITTERS["constant"](), camera=below_the_lamp()))
    mi.render(scene, integrator=_auto(save_learned=file), spp=256)
    restored = _auto(load_learned=file)
    mi.render(scene, integrator=restored, spp=4)
    assert restored.statistics.learned == "light paths do not pay"
