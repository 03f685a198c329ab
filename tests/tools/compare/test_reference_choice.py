"""The integrator that renders the reference of a comparison, and the messages about it."""

from __future__ import annotations

import json

import pytest

from mitsuba_ext import compare
from mitsuba_ext.compare.reference_choice import choose_integrator
from tests.support import fogs
from tests.support.stage import area, diffuse, film, lookat, rgb, sensor

import mitsuba as mi  # isort: skip

pytestmark = pytest.mark.usefixtures("variant", "without_report")

_GLASS = {"type": "sphere", "bsdf": {"type": "dielectric"}}
_POINT = {"type": "point", "position": [0, 3, 0], "intensity": 10.0}
_BEAM = {"type": "rectangle", "emitter": {"type": "directionalarea", "radiance": rgb(1, 1, 1)}}
_MOVING = {"type": "moving", "translate": [1, 0, 0], "ball": {"type": "sphere"}}
_LAMP = {"type": "sphere", "center": [0, 3, 0], "radius": 0.1, "emitter": area(5.0)}


def _scene(**parts):
    view = sensor(to_world=lookat([0, 0.3, 6], [0, 0, 0], [0, 1, 0]), film=film(8, 8))
    return {"type": "scene", "sensor": view, "floor": {"type": "rectangle", "bsdf": diffuse(0.5)},
            **parts}  # fmt: skip


def _grid_of_colours():
    tensor = mi.TensorXf([[[[0.5, 1, 2]] * 2] * 2] * 2)
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(tensor), "raw": True,
              "to_world": mi.ScalarTransform4f().translate(-1).scale(2)}  # fmt: skip
    return {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.5}


def _fog_in_an_instance():
    group = {"type": "shapegroup", "id": "group", "cube": fogs.cube(fogs.homogeneous())}
    return _scene(group=group, copy={"type": "instance", "of": {"type": "ref", "id": "group"}},
                  lamp=_LAMP)  # fmt: skip


@pytest.mark.parametrize(
    "scene, expected",
    [
        (lambda: _scene(lamp=_LAMP, ball=_GLASS), "path"),
        (lambda: _scene(lamp=_POINT), "path"),
        (lambda: _scene(lamp=_POINT, ball=_GLASS), "bdpt"),
        (lambda: _scene(lamp=_BEAM), "bdpt"),
        (lambda: fogs.fog(), "volpath"),
        (lambda: fogs.fog(medium=fogs.grid()), "volpath"),
        (_fog_in_an_instance, "volpath"),
        (lambda: fogs.fog(medium=fogs.homogeneous([1.0, 0.5, 0.2])), "composed_path"),
        (lambda: fogs.fog(medium=_grid_of_colours()), "composed_path"),
        (lambda: _scene(lamp=_LAMP, ball=_MOVING), "composed_path"),
    ],
    ids=["glass", "point", "point-and-glass", "beam", "fog", "smoke", "instance", "coloured-fog",
         "coloured-smoke", "motion"],
)  # fmt: skip
def test_the_reference_comes_from_an_integrator_that_sees_the_whole_scene(scene, expected):
    loaded = compare.load_scene(scene(), keep_integrator=False)
    chosen = choose_integrator(loaded)
    assert chosen.integrator == expected
    assert bool(chosen.remarks) == (expected != "path")


def test_light_that_the_reference_lacks_is_named():
    fog = compare.load_scene({**fogs.fog("point"), "ball": _GLASS}, keep_integrator=False)
    assert choose_integrator(fog).integrator == "bdpt"
    meter = {"type": "radiancemeter", "film": film(1, 1)}
    scene = {**_scene(lamp=_BEAM), "sensor": meter}
    chosen = choose_integrator(compare.load_scene(scene, keep_integrator=False))
    assert chosen.integrator == "path" and "lacks light" in chosen.remarks[0]


def test_in_fog_errors_are_relative_to_an_image_with_the_fog(tmp_path):
    warned = []
    comparison = compare.Comparison(
        fogs.fog("area", fogs.homogeneous(2.0)), ["volpath", "path"], compare.equal_samples(16),
        seeds=1, reference_spp=512, folder=tmp_path, warn=warned.append,
    )  # fmt: skip
    (scene,) = comparison.run(progress=False)["scenes"]
    volpath, path = scene["integrators"]
    assert scene["reference"]["integrator"] == "volpath"
    assert volpath["levels"][0]["figures"]["relmse"]["value"] < 1  # 129 to the image of path
    assert [note for note in path["notes"] if "media" in note] and not volpath["notes"]
    assert scene["warnings"] == ['"volpath" renders the reference: the scene has participating '
                                 "media"]  # fmt: skip
    assert len(warned) == 2


def test_path_renders_the_reference_of_fog_if_asked_to_with_a_warning(tmp_path, run):
    comparison = compare.Comparison(
        fogs.fog("area"), ["volpath"], compare.equal_samples(1), seeds=1, reference_spp=16,
        reference_integrator="path", folder=tmp_path,
    )  # fmt: skip
    (scene,) = comparison.run(progress=False)["scenes"]
    assert scene["reference"]["integrator"] == "path"
    assert any("treats them as absent" in warning for warning in scene["warnings"])

    # The same file, given by its name
    file = tmp_path / scene["reference"]["path"]
    comparison = compare.Comparison(
        compare.SceneSetup(fogs.fog("area"), reference=file), ["volpath"],
        compare.equal_samples(1), seeds=1, folder=tmp_path / "other",
    )  # fmt: skip
    (scene,) = comparison.run(progress=False)["scenes"]
    assert any("treats them as absent" in warning for warning in scene["warnings"])
    record = json.loads(run("diff", file, file, "--json")[1])
    assert "treats them as absent" in record["remarks"]["reference"][0]
