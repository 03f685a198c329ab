"""What ``composed_prb`` says of gradients that it does not have."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.util.errors import one_line
from tests.support.gradients import make, small
from tests.support.stage import rectangle, stage

pytestmark = pytest.mark.usefixtures("variant")


def _said_after_a_step(capfd, bsdf: dict[str, Any], end: str, assigns: bool) -> str:
    scene = mi.load_dict(stage(floor=rectangle(bsdf=bsdf)), optimize=False)
    parameters, integrator = mi.traverse(scene), make()
    key = next(key for key in parameters.keys() if key.endswith(end))
    dr.enable_grad(parameters[key])
    if assigns:
        parameters[key] = parameters[key]
        parameters.set_dirty(key)
        parameters.update()
    capfd.readouterr()
    for seed in range(2):
        image = mi.render(scene, parameters, integrator=integrator, seed=seed, spp=4)
        dr.backward(dr.mean(image))
    said = capfd.readouterr()
    return said.out + said.err


@pytest.mark.parametrize("assigns", [False, True])
def test_a_warning_names_parameters_without_gradients_once(capfd, assigns: bool) -> None:
    """Mitsuba's ``principled`` computes its refractive index when ``specular`` is updated."""
    said = _said_after_a_step(capfd, {"type": "principled"}, "specular", assigns)
    assert said.count("no sample") == said.count("floor.bsdf.specular") == (not assigns)


def test_optimizing_two_sets_of_parameters_in_turns_warns_once(capfd) -> None:
    scene = mi.load_dict(stage(floor=rectangle(bsdf={"type": "principled", "clearcoat": 0.0})))
    parameters, integrator = mi.traverse(scene), make()
    keys = [key for key in parameters.keys() if key.endswith(("clearcoat.value", "color.value"))]
    assert len(keys) == 2
    capfd.readouterr()
    for step in range(4):
        key = keys[step % 2]
        dr.enable_grad(parameters[key])
        parameters.set_dirty(key)
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator, spp=4)))
        dr.disable_grad(parameters[key])
    said = capfd.readouterr()
    assert (said.out + said.err).count("no sample") == 1


@pytest.mark.parametrize(
    "bsdf, end",
    [({"type": "blendbsdf", "weight": 0.4, "a": {"type": "diffuse"}, "b": {"type": "conductor"}},
      "weight.value"),
     ({"type": "mask", "bsdf": {"type": "thindielectric"}}, "opacity.value")],
    ids=lambda x: x["type"] if isinstance(x, dict) else "",
)  # fmt: skip
def test_a_warning_names_parameters_whose_gradients_are_wrong(capfd, bsdf: dict, end: str) -> None:
    said = _said_after_a_step(capfd, bsdf, end, True)
    assert said.count(f"the gradients of floor.bsdf.{end} ") == 1


def test_gradients_of_another_scene_in_memory_refuse_no_render() -> None:
    optimized, other = (mi.load_dict(stage(), optimize=False) for _ in range(2))
    parameters = small(optimized)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
    dr.enable_grad(parameters[key])
    parameters.update()
    plain = mi.load_dict({"type": "composed_path", "max_depth": 3})
    with pytest.raises(NotImplementedError, match="does not compute gradients"):
        plain.render(optimized, spp=1)
    assert plain.render(other, spp=1).numpy().mean() > 0


@pytest.mark.parametrize("end", ["floor.to_world", "vertex_texcoords"])
def test_geometry_and_decisions_without_gradients_are_refused(end: str) -> None:
    scene = mi.load_dict(stage(), optimize=False)
    parameters = small(scene)
    key = next(key for key in parameters.keys() if key.endswith(end))
    with pytest.raises(RuntimeError) as error:
        dr.enable_grad(getattr(parameters[key], "matrix", parameters[key]))
        parameters.update()
        image = mi.render(scene, parameters, integrator=make(), spp=1)
        dr.backward(dr.mean(image, axis=None))
    causes = [one_line(error.value), str(error.value.__cause__)]
    assert any("which changes geometry" in text for text in causes), causes
    for parameters, message in (
        ({"next_event": "resampled"}, 'no gradients with the "resampled_lights"'),
        ({"directions": "swarm"}, "no gradients"),
        ({"aovs": "d:depth"}, 'no parameter "aovs"'),
    ):
        with pytest.raises(RuntimeError, match=message):
            make(**parameters)
