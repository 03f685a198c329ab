"""The learned state of a render can be saved as a whole, and serves the next render of the
scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.inputs.plugin_text import parse_plugin
from mitsuba_ext.planning import kept_learning
from mitsuba_ext.planning.learned_file import FORM, LearnedFile
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.util import archives
from tests.support.stage import film, sensor, stage
from tests.support.statistical import load, one_thread, some

pytestmark = pytest.mark.usefixtures("variant")

#: All that learns, in several combinations.
LEARNING = {
    "guide and lights": "auto_path:rr_depth=2",
    "tiles": "composed_path:directions=[guided_directions:regions=tiles,always_guide=true]",
    "lights and roulette": "neepp:rejection=true",
    "visibility": "neepp:rejection=true,light_sampling=spatial",
}


def _integrator(text: str, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({**parse_plugin(text), "max_depth": 6, **parameters})


def _small(name: str) -> mi.Scene:
    return load(name, width=64, height=36)


def _larger_film() -> mi.Sensor:
    film = {"type": "hdrfilm", "width": 80, "height": 60}
    return mi.load_dict({"type": "perspective", "film": film})


@pytest.mark.parametrize("name", some("lights and roulette", of=LEARNING))
def test_a_restored_render_draws_the_samples_of_the_last_stage(name, tmp_path: Path) -> None:
    """Without pilots: the last stage of the same seed is the whole render."""
    scene, file = _small("rooms"), tmp_path / "learned.npz"
    first = _integrator(LEARNING[name], save_learned=str(file))
    with one_thread():
        first.render(scene, seed=3, spp=64)
        assert first.statistics.learning_seconds > 0
        images = []
        for _ in range(2):
            again = _integrator(LEARNING[name], load_learned=str(file))
            images.append(np.array(again.render(scene, seed=5, spp=8)))
            assert again.statistics.spp == 8
            assert again.statistics.passes == 1
    np.testing.assert_array_equal(*images)


@pytest.fixture
def nothing_kept():
    kept_learning.forget()
    yield
    kept_learning.forget()


@pytest.mark.usefixtures("nothing_kept")
@pytest.mark.slow
def test_only_later_renders_of_the_same_scene_use_the_kept_state() -> None:
    scene, keeping = _small("rooms"), {"max_depth": 6, "keep_learned": True}
    first = mi.load_dict({"type": "neepp", **keeping})
    first.render(scene, seed=3, spp=32)
    assert first.statistics.learning_seconds > 0

    def learns(scene: mi.Scene, spp: int = 32, sensor: mi.Sensor | int = 0, **more) -> bool:
        """Whether another integrator learns, with another seed."""
        integrator = mi.load_dict({"type": "neepp", **keeping, **more})
        view = scene.sensors()[0] if sensor == 0 else sensor
        plan = integrator.plan_learning(Request(scene, view), spp)
        integrator.render(scene, sensor, seed=5, spp=spp)
        assert integrator.statistics.learned
        assert plan.restore is None or integrator.statistics.passes == 1
        return plan.restore is None

    assert not learns(scene) and not learns(_small("rooms"), spp=8)
    assert learns(scene, grid=4) and learns(scene, sensor=_larger_film())
    assert learns(scene, spp=64), "its pilots have more samples"
    other = _small("rooms")
    parameters = mi.traverse(other)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
    parameters[key] = mi.Color3f(0.1)
    parameters.update()
    assert learns(other)
    assert learns(scene, keep_learned=False)


@pytest.mark.usefixtures("nothing_kept")
@pytest.mark.parametrize("name", ["auto", pytest.param("adaptive", marks=pytest.mark.slow)])
def test_kept_and_loaded_states_draw_the_same_samples(name, tmp_path: Path) -> None:
    scene, file = _small("rooms"), str(tmp_path / "learned.npz")

    def make(**parameters) -> mi.Integrator:
        inner = {"type": "auto_path" if name == "adaptive" else name, "max_depth": 6, **parameters}
        return mi.load_dict({"type": name, "in": inner} if name == "adaptive" else inner)

    with one_thread():
        make(keep_learned=True, save_learned=file).render(scene, seed=3, spp=128)
        kept, loaded = (make(**{key: value}) for key, value in
                        (("keep_learned", True), ("load_learned", file)))  # fmt: skip
        images = [np.array(each.render(scene, seed=5, spp=32)) for each in (kept, loaded)]
    assert kept.statistics.passes == loaded.statistics.passes <= 8, "neither has pilots"
    np.testing.assert_array_equal(*images)


@pytest.mark.usefixtures("nothing_kept")
def test_what_is_kept_serves_the_same_path_lengths() -> None:
    """A guide learned with a `max_depth` of 4 guides 3 bounces: too few for longer paths."""
    scene = _small("rooms")
    request = Request(scene, scene.sensors()[0])

    def made(**depths: int) -> mi.Integrator:
        return mi.load_dict({"type": "pss_guided", "keep_learned": True, **depths})

    first = made(max_depth=4)
    kept_learning.put(scene, first._learned_by(request.sensor), pilot_spp=32, states={})
    for same, depths in ((True, {"max_depth": 4}), (False, {"max_depth": 8}), (False, {}),
                         (False, {"max_depth": 4, "rr_depth": 2})):  # fmt: skip
        assert (made(**depths).plan_learning(request, 64).restore is not None) == same, depths


@pytest.mark.usefixtures("nothing_kept")
def test_a_render_that_restores_nothing_claims_no_light_paths() -> None:
    """`auto` has never tried light paths for a scene in which nothing was kept."""
    scene, make = _small("rooms"), {"type": "auto", "max_depth": 6, "keep_learned": True}
    integrator = mi.load_dict(make)
    learned_by = integrator._learned_by(scene.sensors()[0])
    kept_learning.put(scene, learned_by, pilot_spp=64, states={})
    integrator.render(scene, seed=5, spp=32)
    assert integrator.statistics.learned.startswith("nothing: an earlier render")
    assert "light_paths" not in integrator.statistics.effects


def test_load_learned_excludes_keep_learned() -> None:
    with pytest.raises((RuntimeError, ValueError), match='leave "keep_learned" out'):
        mi.load_dict({"type": "neepp", "load_learned": "some.npz", "keep_learned": True})


@pytest.mark.slow
def test_restored_decisions_equal_the_saved_ones(tmp_path: Path) -> None:
    """The tables themselves, bit for bit."""
    scene, file = _small("rooms"), tmp_path / "learned.npz"
    integrator = mi.load_dict({
        "type": "composed_path", "max_depth": 6, "rr_depth": 2, "save_learned": str(file),
        "directions": {"type": "guided_directions", "always_guide": True},
        "next_event": "contribution", "shadow_test": "visibility_roulette",
    })  # fmt: skip
    stages = []
    schedule = integrator.schedule

    def spied(*arguments):
        made = schedule(*arguments)
        stages.append(made)
        return made

    integrator.schedule = spied
    integrator.render(scene, seed=3, spp=64)
    again = mi.load_dict({
        "type": "composed_path", "max_depth": 6, "rr_depth": 2, "load_learned": str(file),
        "directions": {"type": "guided_directions", "always_guide": True},
        "next_event": "contribution", "shadow_test": "visibility_roulette",
    })  # fmt: skip
    request = Request(scene, scene.sensors()[0], 3)
    restored = again.schedule(request, (64,), again.plan_learning(request, 64))
    restored.next_stage()
    old, new = stages[0].decisions, restored.decisions
    for key, array in old.directions.trees.state().items():
        np.testing.assert_array_equal(array, new.directions.trees.state()[key])
    for key, array in old.directions.regions.state().items():
        np.testing.assert_array_equal(array, new.directions.regions.state()[key])
    for key, array in old.roulette.state().items():
        np.testing.assert_array_equal(array, new.roulette.state()[key])
    np.testing.assert_array_equal(old.next_event._table, new.next_event._table)


def test_files_of_other_scenes_and_parameters_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "learned.npz"
    _integrator("neepp", save_learned=str(file)).render(_small("rooms"), spp=16)
    with pytest.raises(ValueError, match="another scene"):
        _integrator("neepp", load_learned=str(file)).render(_small("open"), spp=16)
    with pytest.raises(ValueError, match="other parameters"):
        _integrator("neepp:grid=4", load_learned=str(file)).render(_small("rooms"), spp=16)
    with pytest.raises(ValueError, match="max_depth = 6, .* instead of .*max_depth = 8, "):
        deeper = _integrator("neepp", load_learned=str(file), max_depth=8)
        deeper.render(_small("rooms"), spp=16)
    with pytest.raises(ValueError, match="film = "):
        _integrator("neepp", load_learned=str(file)).render(_small("rooms"), _larger_film(), spp=16)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        _integrator("neepp", load_learned=str(tmp_path / "none")).render(_small("rooms"), spp=16)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0xFF
    file.write_bytes(data)
    with pytest.raises(ValueError, match="damaged"):
        _integrator("neepp", load_learned=str(file)).render(_small("rooms"), spp=16)
    with pytest.raises(ValueError, match="save_learned"):
        target = tmp_path / "no folder" / "learned.npz"
        _integrator("neepp", save_learned=str(target)).render(_small("rooms"), spp=16)


def test_files_of_other_kinds_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path, scene, where = tmp_path / "learned.npz", _small("open"), '"name": the parameter "key"'
    file = LearnedFile(path, scene, "made by", where)
    assert file.load() is None
    arrays = {"counts": np.arange(4), "name": np.array("text")}
    file.save({"one": arrays, "other": {"counts": np.arange(3)}})
    stored, content = file.load().parts(), path.read_bytes()
    assert {part: its.shape("counts") for part, its in stored.items()} == {
        "one": (4,), "other": (3,)
    }  # fmt: skip

    def refusal() -> str:
        with pytest.raises(ValueError) as caught:
            file.load()
        message = str(caught.value)
        assert message.startswith(f'{where} names "{path}", which ') and "\n" not in message
        return message

    for form, words in {
        FORM[:-1] + "0": "which is of another version: delete it",
        "mitsuba_ext light-map 3": "which is a mitsuba_ext light-map 3: delete it",
    }.items():
        archives.write(path, form, arrays)
        assert words in refusal()
    archives.write(path, FORM, arrays)
    assert 'without the array "scene"' in refusal()
    for others in ({}, {"format": np.zeros(0)}, {"scene": np.array([{}], dtype=object)}):
        np.savez(path, **{**arrays, **others})
        assert "is damaged, or of another kind" in refusal()
    image = b"\x76\x2f\x31\x01\x02\x00\x00\x00channels\x00"
    for broken in (b"", b"PK nothing", image, content[:-500], content[:100], content[:-1]):
        path.write_bytes(broken)
        assert "damaged" in refusal()
    path.unlink()
    path.mkdir()
    assert "of another kind" in refusal()


def test_to_load_and_to_save_at_once_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match='leave "save_learned" out'):
        _integrator("neepp", save_learned=str(tmp_path / "a"), load_learned=str(tmp_path / "b"))


@pytest.mark.parametrize(("plugin", "key", "suffix"), [
    ("neepp", "save_learned", ".npz"), ("irradiance_cache", "cache_file", ".npz"),
    ("mlt", "chain_file", ".npz"), ("bdpt", "technique_images", ".exr"),
])  # fmt: skip
def test_files_of_other_kinds_are_not_replaced(tmp_path: Path, plugin, key, suffix) -> None:
    """A scene names the file, and may be somebody else's."""
    file, link = tmp_path / f"mine{suffix}", tmp_path / f"link{suffix}"
    file.write_text("my text")
    link.symlink_to(file)
    scene = mi.load_dict(stage(camera=sensor(film=film(8, 8))))
    for target in (file, link):
        integrator = mi.load_dict({"type": plugin, "max_depth": 3, key: str(target)})
        with pytest.raises(ValueError, match="another file, which is not replaced|damaged"):
            integrator.render(scene, spp=16)
    assert file.read_text() == "my text" and link.is_symlink()
