"""The means of short renders, where pilots are a large part of the samples.

Light comes through small openings here. A few bright paths decide what is learned, and they are in
the image: if they also decided which samples count, the image would have a wrong mean.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice import light_paths
from mitsuba_ext.planning import planner, verdicts
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor
from tests.support.statistical import THRESHOLD, batches, load, z_welch

pytestmark = pytest.mark.usefixtures("variant")

_SIZE = {"width": 64, "height": 36}


def _gap(edge: float) -> mi.Scene:
    """A room and a closet, in which a lamp faces away from a square gap of this edge."""
    x, y = ([0, 1, 0], 90), ([1, 0, 0], 90)

    def wall(place: list, size: list, turn: tuple = (x[0], 0), **children: Any) -> dict[str, Any]:
        to_world = mi.ScalarTransform4f().translate(place).rotate(*turn).scale([*size, 1])
        children = children or {"bsdf": {"type": "twosided", "inside": diffuse(0.7)}}
        return rectangle(to_world, **children)

    half = edge / 2
    walls = [
        wall([0.5, 0, 0], [1.5, 1]), wall([0.5, 0, 2], [1.5, 1]),
        wall([-1, 0, 1], [1, 1], x), wall([2, 0, 1], [1, 1], x),
        wall([0.5, -1, 1], [1.5, 1], y), wall([0.5, 1, 1], [1.5, 1], y),
        wall([0, 0, (1 - half) / 2], [(1 - half) / 2, 1], x),
        wall([0, 0, (3 + half) / 2], [(1 - half) / 2, 1], x),
        wall([0, (1 + half) / 2, 1], [half, (1 - half) / 2], x),
        wall([0, -(1 + half) / 2, 1], [half, (1 - half) / 2], x),
    ]  # fmt: skip
    to_world = lookat([1.8, -0.9, 1.2], [0.6, 0.5, 0.8], [0, 0, 1])
    return mi.load_dict({
        "type": "scene", **{f"wall_{i}": x for i, x in enumerate(walls)},
        "lamp": wall([-0.02, 0, 1.6], [0.2, 0.2], (x[0], -90), emitter=area(1000.0)),
        "camera": sensor(to_world=to_world, film=film(**_SIZE), fov=70.0),
    })  # fmt: skip


def _scene(name: str) -> mi.Scene:
    if name == "gap":
        return _gap(0.1)
    return load(name, **_SIZE, rfilter="box", integrator="path")


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["gap", "keyhole"])
def test_short_renders_have_the_right_mean(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pilots have an eighth of the 64 samples."""
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    # Light paths are tried in such short renders, too
    monkeypatch.setattr(planner, "LIGHT_PATH_KERNELS", 0.0)
    monkeypatch.setattr(light_paths, "_LEAST_SPARSE", 1 << 10)
    loaded = _scene(scene)

    def means(name: str, spp: int, seeds: range) -> np.ndarray:
        integrator = mi.load_dict({"type": name, "max_depth": 5})
        return batches(loaded, integrator, spp, seeds).mean(axis=(1, 2, 3))

    expected = means("bdpt", 256, range(1001, 1017))
    for plugin in ("auto_path", "auto"):
        found = means(plugin, 64, range(1, 41))
        error = np.sqrt(sum(x.var(ddof=1) / len(x) for x in (found, expected))) / expected.mean()
        z = float(z_welch(found, expected))
        print(f"{plugin} {found.mean() / expected.mean():.4f} ± {error:.4f}, z = {z:.1f}")
        assert abs(z) < THRESHOLD and error < 0.02
