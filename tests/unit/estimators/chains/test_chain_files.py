"""A render with chains continues the file of an earlier render as if there had been no break."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.chains.looped import LoopedChains
from mitsuba_ext.estimators.chains.numbers import generator
from mitsuba_ext.estimators.chains.path_chains import PathChains
from mitsuba_ext.estimators.chains.redistribution import RedistributionRender
from mitsuba_ext.estimators.chains.stored import arrays_of, value_of
from mitsuba_ext.estimators.chains.target import Contribution
from mitsuba_ext.util.stored_arrays import StoredArrays
from tests.support.chain_integrators import ALONE, pssmlt
from tests.support.stage import film, sensor, stage
from tests.support.statistical import one_thread, some

pytestmark = pytest.mark.usefixtures("variant")

#: 64 mutations per pixel are 16 of each chain.
_FEW = {"chains": 1024, "luminance_samples": 4096}


def _render(scene: mi.Scene, file: Path | str, spp: int, seed: int = 5, **parameters: Any) -> Any:
    integrator = pssmlt(**{**_FEW, **ALONE, "chain_file": str(file), **parameters})
    return np.array(integrator.render(scene, seed=seed, spp=spp)), integrator


#: Other integrators with chains.
_OTHERS = {
    "mlt": {"type": "mlt", **_FEW, **ALONE},
    "erpt": {"type": "erpt", "luminance_samples": 4096, **ALONE},
    "erpt, everything": {"type": "erpt", "outliers": 0.0, "chain_length": 8, **ALONE},
    "erpt, paths": {"type": "erpt", "mutations": "path", "outliers": 2.0, **ALONE},
    "erpt, filters": {"type": "erpt", "proposal_filter": 3, **ALONE},
}


def test_arrays_are_put_together_as_they_were() -> None:
    rng = generator(3, dr.arange(mi.UInt32, 5))
    rng.next_float32()
    place, colour = mi.Point2f([1, 2], [3, 4]), mi.Color3f([1, 2], [3, 4], [5, 6])
    found = Contribution(place, colour, mi.Float(7, 8))
    tree = [rng, [found, mi.UInt32(1, 2)]]
    stored, kinds = StoredArrays.of(arrays_of(tree, "all")), [mi.PCG32, [Contribution]]
    again, (other,) = value_of(stored, "all", kinds, None, {})
    numbers = value_of(stored, "all/1/1", mi.UInt32, 2, {"1": (1, 2)})
    np.testing.assert_array_equal(again.next_float32().numpy(), rng.next_float32().numpy())
    np.testing.assert_array_equal(numbers.numpy(), [1, 2])
    for key, value in vars(found).items():
        assert type(getattr(other, key)) is type(value)
        np.testing.assert_array_equal(getattr(other, key).numpy(), value.numpy())


@pytest.mark.parametrize("parameters", [
    {}, {"two_stage": True}, {"direct_samples": 16}, {"kelemen_style_weights": False},
    pytest.param({"bidirectional": True}, marks=pytest.mark.slow),
], ids=str)  # fmt: skip
def test_a_render_continues_where_it_was_stopped(tmp_path: Path, parameters: dict) -> None:
    """With the same samples to start from, up to rounding."""
    scene, file = mi.load_dict(stage()), tmp_path / "chains.npz"
    spp = 8 if parameters.get("bidirectional") else 64
    with one_thread():
        whole, _ = _render(scene, "", spp, **parameters)
        integrator = pssmlt(**{**_FEW, **ALONE, "chain_file": str(file), **parameters})
        launch, LoopedChains.launch = LoopedChains.launch, 4
        try:
            integrator.progress = lambda fraction: integrator.cancel()
            integrator.render(scene, seed=5, spp=spp)
        finally:
            LoopedChains.launch = launch
        assert integrator.statistics.interrupted and 0 < integrator.statistics.spp < spp
        image, integrator = _render(scene, file, spp, **parameters)
    assert integrator.statistics.spp == spp and not integrator.statistics.interrupted
    np.testing.assert_allclose(image, whole, rtol=1e-3, atol=1e-4 * whole.mean())


@pytest.mark.parametrize("which", some("erpt", of=_OTHERS))
def test_renders_of_other_kinds_continue_where_they_were_stopped(
    tmp_path: Path, which: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of chains of paths, and of batches, too."""
    monkeypatch.setattr(RedistributionRender, "max_batch", 32**2)
    monkeypatch.setattr(PathChains, "launch", 4)
    scene, file = mi.load_dict(stage()), tmp_path / "chains.npz"

    def made(file: Path | str) -> Any:
        return mi.load_dict({"max_depth": 4, **_OTHERS[which], "chain_file": str(file)})

    with one_thread():
        whole = np.array(made("").render(scene, seed=5, spp=32))
        integrator = made(file)
        integrator.progress = lambda fraction: integrator.cancel()
        integrator.render(scene, seed=5, spp=32)
        assert integrator.statistics.interrupted and 0 < integrator.statistics.spp < 32
        integrator = made(file)
        image = np.array(integrator.render(scene, seed=5, spp=32))
    assert integrator.statistics.spp == 32 and not integrator.statistics.interrupted
    np.testing.assert_allclose(image, whole, rtol=1e-3, atol=1e-4 * whole.mean())


def test_a_finished_render_is_read_and_may_become_longer(tmp_path: Path) -> None:
    scene, file = mi.load_dict(stage()), tmp_path / "chains.npz"
    first, _ = _render(scene, file, 16)
    again, integrator = _render(scene, file, 16)
    np.testing.assert_allclose(again, first, rtol=1e-4, atol=1e-5 * first.mean())
    assert integrator.statistics.rays["camera"] == 16 * 256
    longer, integrator = _render(scene, file, 512)
    assert integrator.statistics.spp == 512 and not integrator.statistics.interrupted
    truth, _ = _render(scene, "", 4096, seed=9)
    assert np.abs(longer - truth).mean() < 0.75 * np.abs(first - truth).mean()


@pytest.mark.parametrize(("changes", "words"), [
    ({"seed": 6}, "other parameters"),
    ({"p_large": 0.5}, "other parameters"),
    ({"max_depth": 5}, "other parameters"),
    ({"camera": {"film": film(16, 8)}}, "other parameters"),
    ({"camera": {"fov": 20.0}}, "other parameters"),
    ({"wall": None}, "another scene"),
])  # fmt: skip
def test_the_file_of_another_render_is_refused(tmp_path: Path, changes: dict, words: str) -> None:
    file = tmp_path / "chains.npz"
    _render(mi.load_dict(stage()), file, 4)
    changes = dict(changes)
    camera = sensor(**changes.pop("camera", {}))
    wall = {"wall": changes.pop("wall")} if "wall" in changes else {}
    scene = mi.load_dict(stage(camera=camera, **wall))
    with pytest.raises(ValueError, match=f'(?s)"pssmlt".*"chain_file".*{words}'):
        _render(scene, file, 8, **changes)


def test_a_damaged_file_and_a_missing_folder_are_named(tmp_path: Path) -> None:
    scene, file = mi.load_dict(stage()), tmp_path / "chains.npz"
    file.write_text("nothing")
    with pytest.raises(ValueError, match='(?s)"chain_file".*damaged'):
        _render(scene, file, 4)
    with pytest.raises(ValueError, match='(?s)"chain_file".*no such folder'):
        _render(scene, tmp_path / "none" / "chains.npz", 4)


def test_an_error_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    scene, file = mi.load_dict(stage()), tmp_path / "chains.npz"
    _render(scene, file, 16)
    before = file.read_bytes()
    integrator = pssmlt(**{**_FEW, **ALONE, "chain_file": str(file)})

    def fail(fraction: float) -> None:
        raise OSError("no terminal")

    integrator.progress = fail
    with pytest.raises(OSError, match="no terminal"):
        integrator.render(scene, seed=5, spp=64)
    assert file.read_bytes() == before
