"""Damaged files are refused in a sentence, or make no difference: no traceback, no other image, and
no crash. Each kind of file that we write is damaged in a few ways, with ``slow`` in a thousand."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.long_renders.bundle import Bundle, _digest
from mitsuba_ext.long_renders.folder import CheckpointFolder
from mitsuba_ext.long_renders.state import Batch, BatchResult, RenderState
from mitsuba_ext.planning import verdicts
from mitsuba_ext.planning.learned_file import FORM
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.totals import RenderTotals
from mitsuba_ext.util import archives
from mitsuba_ext.util.errors import InputError
from tests.support.damage import contents, damaged, damages, edits
from tests.support.stage import film, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")

#: How often a file is damaged in the default run, and in the long one.
COUNTS = [20, pytest.param(1000, marks=pytest.mark.slow)]

#: Integrators that learn, which together save the states of all learners.
LEARNED: dict[str, dict[str, Any]] = {
    "regions": {
        "type": "composed_path", "next_event": "contribution", "shadow_test": "visibility_roulette",
        "directions": {"type": "guided_directions", "always_guide": True},
    },
    "lights": {"type": "neepp", "grid": 4},
    "tiles": {
        "type": "composed_path",
        "directions": {"type": "guided_directions", "regions": "tiles", "always_guide": True},
        "scattering": {"type": "focal_points", "always_use": True},
    },
    "maps": {"type": "swarm_path", "always_use": True},
    "two stages": {"type": "two_stage", "visibility": "world"},
    "light vertices": {"type": "bdpt", "connections": 1, "subpath_selection": "visibility"},
    "light paths": {"type": "bdpt", "light_paths": "auto"},
}  # fmt: skip

#: Integrators with files of chains.
_FEW = {"chains": 256, "luminance_samples": 1024, "direct_samples": -1}
CHAINS: dict[str, dict[str, Any]] = {
    "pssmlt": {"type": "pssmlt", "bidirectional": False, **_FEW},
    "pssmlt with light paths": {"type": "pssmlt", "bidirectional": True, **_FEW},
    "mlt": {"type": "mlt", **_FEW},
    "erpt": {"type": "erpt", "luminance_samples": 1024, "direct_samples": -1},
}


def _scene(**changes: Any) -> mi.Scene:
    return mi.load_dict(stage(camera=sensor(film=film(8, 8)), **changes))


def refused(read: Callable[[], Any]) -> Any | None:
    """What was read; ``None`` if that is refused, in a sentence."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return read()
        except ValueError as error:  # InputError and DamagedError too
            message = str(error)
            assert ": " in message and "\n" not in message and "Traceback" not in message
            assert "delete" in message or isinstance(error, InputError), message
            return None


def _is_equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> bool:
    return found.keys() == expected.keys() and all(
        np.array_equal(found[key], x, equal_nan=x.dtype.kind == "f") for key, x in expected.items()
    )


# ---- Checkpoints ----


def _result(index: int) -> BatchResult:
    rng = np.random.default_rng(index)
    return BatchResult(
        Batch(0, index, 4), rng.random((5, 7, 4), np.float32), True,
        rng.random((5, 7, 3), np.float32), ("R", "G", "B"), 3, (),
        RenderTotals({"camera": 140}, render_seconds=1.0), b"learned",
    )  # fmt: skip


def _checkpoint(path: Path) -> tuple[CheckpointFolder, list[RenderState]]:
    """A folder with a state and the one before it."""
    folder, states = CheckpointFolder(path), []
    for count in (2, 3):
        state = RenderState()
        for index in range(count):
            state.add(_result(index))
        path.mkdir(exist_ok=True)
        folder.save(state)
        states.append(state)
    return folder, states


@pytest.mark.parametrize("count", COUNTS)
def test_a_damaged_checkpoint_falls_back_to_the_one_before(tmp_path: Path, count: int) -> None:
    folder, states = _checkpoint(tmp_path / "kept")
    expected = {len(state.done): state.arrays() for state in states}
    file, fallen = tmp_path / "kept" / "state.npz", 0
    for _ in damages(file, count, 1):
        state = folder.load()
        assert _is_equal(state.arrays(), expected[len(state.done)])
        assert (len(state.done) == 2) == (folder.damaged is not None)
        fallen += len(state.done) == 2
    assert fallen > 0.8 * count


@pytest.mark.parametrize("count", COUNTS)
def test_edited_checkpoints_are_states_or_fall_back(tmp_path: Path, count: int) -> None:
    folder, _ = _checkpoint(tmp_path / "kept")
    for _ in edits(tmp_path / "kept" / "state.npz", count, 2):
        state = folder.load()
        assert state.spp == 4 * len(state.done) or folder.damaged is None
        assert state.images.mean.shape == (5, 7, 3) == state.images.variance.shape
        assert state.film.contents.shape[:2] == (5, 7)
        state.add(_result(9)) if folder.damaged else None
        json.dumps(state.totals.known())


def test_a_state_of_another_folder_is_not_taken_up(tmp_path: Path) -> None:
    folders = []
    for scene in ("one", "two"):
        folder = CheckpointFolder(tmp_path / scene)
        folder.path.mkdir()
        folder.describe({"scene hash": scene})
        state = RenderState()
        state.add(_result(0))
        folder.save(state)
        folders.append(folder.path / "state.npz")
    assert CheckpointFolder(tmp_path / "one").load().spp == 4
    folders[0].write_bytes(folders[1].read_bytes())
    assert refused(CheckpointFolder(tmp_path / "one").load) is None


def test_a_checkpoint_whose_states_are_both_damaged_is_refused(tmp_path: Path) -> None:
    folder, _ = _checkpoint(tmp_path / "kept")
    for name in ("state.npz", "state.before.npz"):
        next(damages(tmp_path / "kept" / name, 1, 3))
    assert refused(folder.load) is None


@pytest.mark.parametrize("count", COUNTS)
def test_a_damaged_description_is_refused_or_is_the_same(tmp_path: Path, count: int) -> None:
    folder = CheckpointFolder(tmp_path)
    description = {
        "scene": "a/b.xml", "scene hash": "12", "scene files": {"b.xml": "1"}, "seed": 3,
        "scene files hash": "3", "size": "7x5", "versions": {"mitsuba": "3.9.1"},
    }  # fmt: skip
    folder.describe(description)
    for _ in damages(tmp_path / "render.json", count, 4):
        refused(lambda: folder.describe(description))
    odd = '{"scene files hash": 1, "scene files": 2}'
    for text in ("[]", "3", '"x"', "null", "[" * 100000, odd):
        (tmp_path / "render.json").write_text(text)
        with pytest.raises(InputError, match="render.json|another render"):
            folder.describe(description)


# ---- What was learned ----


def _saved(name: str, scene: mi.Scene, file: Path) -> dict[str, Any]:
    """Renders, and saves what was learned; the integrator that loads it."""
    plugin = {**LEARNED[name], "max_depth": 4, "rr_depth": 2, "pilot_spp": 16}
    mi.load_dict({**plugin, "save_learned": str(file)}).render(scene, seed=1, spp=64)
    return {**plugin, "load_learned": str(file)}


def _restore(plugin: dict[str, Any], scene: mi.Scene) -> None:
    """Reads what was learned, as a render does before its first sample."""
    integrator = mi.load_dict(plugin)
    request = Request(scene, scene.sensors()[0], 5)
    integrator.schedule(request, (4,), integrator.plan_learning(request, 4)).next_stage()


@pytest.mark.parametrize("count", COUNTS)
def test_a_damaged_learned_file_is_refused_or_is_the_same(tmp_path: Path, count: int) -> None:
    scene, file = _scene(), tmp_path / "learned.npz"
    plugin = _saved("regions", scene, file)
    _restore(plugin, scene)
    expected, refusals = contents(file), 0
    for _ in damages(file, count, 5):
        if refused(lambda: _restore(plugin, scene) or 1) is None:
            refusals += 1
        else:
            assert _is_equal(contents(file), expected)
    assert refusals > 0.8 * count


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in ("regions", "lights") else pytest.mark.slow)
    for name in LEARNED
])  # fmt: skip
def test_edited_learned_files_are_refused_or_render(
    tmp_path: Path, name: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verdicts, "pays", lambda *_: True)
    changes = {"sky": {"type": "constant"}} if name == "two stages" else {}
    scene, file = _scene(**changes), tmp_path / "learned.npz"
    plugin = _saved(name, scene, file)
    _restore(plugin, scene)
    rendered = 0
    for index, _ in enumerate(edits(file, count, 6, fixed=("scene", "made_by"))):
        if refused(lambda: _restore(plugin, scene) or 1) and (index % 10 == 0 and rendered < 50):
            rendered += 1
            image = np.array(mi.load_dict(plugin).render(scene, seed=2, spp=2))
            assert np.isfinite(image).all()


# ---- Chains ----


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name == "mlt" else pytest.mark.slow) for name in CHAINS
])  # fmt: skip
def test_edited_chain_files_are_refused_or_render(tmp_path: Path, name: str, count: int) -> None:
    """Lanes, places in memory, lights and random numbers of anybody's choice."""
    scene, file = _scene(), tmp_path / "chains.npz"
    plugin = {**CHAINS[name], "max_depth": 3, "chain_file": str(file)}
    mi.load_dict(plugin).render(scene, seed=1, spp=8)
    fixed, rendered = ("scene", "made_by"), 0
    for _ in edits(file, count, 9, fixed):
        image = refused(lambda: np.array(mi.load_dict(plugin).render(scene, seed=1, spp=9)))
        rendered += image is not None
    assert rendered < count


@pytest.mark.parametrize("count", COUNTS)
def test_damaged_chain_files_are_refused_or_are_the_same(tmp_path: Path, count: int) -> None:
    scene, file = _scene(), tmp_path / "chains.npz"
    plugin = {**CHAINS["mlt"], "max_depth": 3, "chain_file": str(file)}
    mi.load_dict(plugin).render(scene, seed=1, spp=8)
    expected, origin = contents(file), f'"chain_file" names "{file}", which'
    for _ in damages(file, count, 10):
        found = refused(lambda: archives.read(file, FORM, origin, "delete it"))
        assert found is None or _is_equal(contents(file), expected)


# ---- Irradiance ----


@pytest.mark.parametrize("count", COUNTS)
def test_edited_irradiance_files_are_refused_or_make_finite_images(
    tmp_path: Path, count: int
) -> None:
    scene, file = _scene(), tmp_path / "cache.npz"
    plugin = {"type": "irradiance_cache", "max_depth": 3, "gather_samples": 16, "effort": 4.0,
              "cache_file": str(file)}  # fmt: skip
    integrator = mi.load_dict(plugin)
    integrator.render(scene, seed=1, spp=8)
    for index, _ in enumerate(edits(file, count, 11, fixed=("scene", "made_by"))):
        if refused(lambda: (integrator._known(integrator._file(scene)),)) and index % 10 == 0:
            assert np.isfinite(np.array(integrator.render(scene, seed=2, spp=1))).all()


# ---- Bundles ----


@pytest.mark.parametrize("count", COUNTS)
def test_a_damaged_bundle_is_refused(count: int) -> None:
    files, folders = {"/a/scene.xml": b"<scene/>" * 9, "/a/mesh.ply": bytes(range(256))}, ("/a",)
    digest, rng = _digest(files, folders), np.random.default_rng(12)
    with Bundle(files, folders, digest).unpacked() as moved:
        assert Path(moved("/a/mesh.ply")).read_bytes() == files["/a/mesh.ply"]
    for _ in range(count):
        name = "/a/scene.xml" if rng.random() < 0.5 else "/a/mesh.ply"
        other = {**files, name: damaged(files[name], rng)}
        bundle = Bundle(other, folders, digest)
        if other != files:
            with pytest.raises(InputError, match="damaged"), bundle.unpacked():
                pass
