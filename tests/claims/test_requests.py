"""A render changes no parameter of its integrator, while it runs or if it fails; what it is asked
for is its own."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.nesting import with_nested
from tests.support.stage import sensor, stage

pytestmark = pytest.mark.usefixtures("variant")

#: The attributes that a render sets because users read them afterwards; and of ``composed_prb``,
#: what it remembers for the next render.
_RESULTS = {
    "statistics", "learners", "techniques", "maps", "records", "rounds", "progress", "coverage",
    "_remembered", "_renders",
}  # fmt: skip

PATH = {"type": "composed_path", "max_depth": 3}


def _parameters(integrator: mi.Integrator) -> list[dict[str, Any]]:
    return [
        {key: value for key, value in vars(each).items() if key not in _RESULTS}
        for each in with_nested(integrator)
    ]


@pytest.mark.parametrize("plugin", [
    PATH,
    {"type": "neepp", "max_depth": 3, "timeout": 100.0},
    {"type": "vcm", "max_depth": 3},
    {"type": "sppm", "max_depth": 3},
    {"type": "pssmlt", "max_depth": 3, "timeout": 1.0},
    {"type": "photon_map", "max_depth": 3, "photons": 1000},
    {"type": "instant_radiosity", "max_depth": 3},
    {"type": "irradiance_cache", "max_depth": 3, "gather_samples": 16},
    {"type": "adaptive", "timeout": 100.0, "nested": PATH},
    {"type": "ecoc_dof", "nested": PATH},
    {**PATH, "checkpoint": "kept"},
], ids=lambda plugin: f"{plugin['type']}{' in batches' * ('checkpoint' in plugin)}")  # fmt: skip
def test_a_render_changes_no_parameter_even_if_it_fails(
    plugin: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lens = sensor("thinlens", aperture_radius=0.1, focus_distance=4.0)
    scene, integrator = mi.load_dict(stage(camera=lens)), mi.load_dict(plugin)
    before, during = _parameters(integrator), []

    def fail(done: float) -> None:
        during.append(_parameters(integrator))
        raise OSError("no terminal")

    integrator.progress = fail
    with pytest.raises(OSError, match="no terminal"):
        integrator.render(scene, spp=32)
    assert during == [before] and _parameters(integrator) == before
    integrator.progress = None
    integrator.render(scene, spp=4)
    assert _parameters(integrator) == before


def test_a_request_is_for_one_render_only() -> None:
    """An integrator renders another scene in the midst of a render that nests it, which has a
    timeout; and the same scene afterwards."""
    scenes = [mi.load_dict(stage(camera=sensor("perspective"))) for _ in range(2)]
    inner = mi.load_dict(PATH)
    outer = mi.load_dict({"type": "adaptive", "timeout": 1e-3, "nested": inner})
    expected = inner.render(scenes[1], spp=8, seed=3).numpy()
    images = []

    def progress(done: float) -> None:
        if not images:
            images.append(inner.render(scenes[1], spp=8, seed=3).numpy())

    outer.render(scenes[0], spp=1 << 16, progress=progress)
    assert outer.statistics.spp < 1 << 16 and inner.statistics.spp == 8
    images.append(inner.render(scenes[1], spp=8, seed=3).numpy())
    for image in images:
        np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5)


def test_two_threads_ask_one_integrator_for_different_things() -> None:
    """Different scenes, numbers of samples, and a timeout for one of them."""
    integrator = mi.load_dict({**PATH, "type": "vcm"})
    scenes = [mi.load_dict(stage(camera=sensor("perspective"))) for _ in range(2)]
    wishes = [{"spp": 1 << 16, "timeout": 1e-3}, {"spp": 8, "samples_before": 1 << 10}]
    seen: dict[int, Any] = {}

    def render(number: int) -> None:
        done: list[float] = []
        integrator.render(scenes[number], seed=number, progress=done.append, **wishes[number])
        seen[number] = done

    threads = [threading.Thread(target=render, args=(number,)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(100)
    assert all(done and done[-1] == 1 for done in seen.values()) and len(seen) == 2
    assert integrator.timeout == -1 and integrator.progress is None
