"""Passes for gradients are recorded, and have the gradients of traced ones."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.gradient_pass import ReplayedWalk
from mitsuba_ext.transport import frozen
from mitsuba_ext.transport.walk import Walk
from tests.support.stage import area, bitmap, film, rectangle, sensor, stage

pytestmark = pytest.mark.usefixtures("variant")

#: Ends of the names of the parameters with gradients.
ENDS = (
    "reflectance.data", "alpha.value", "radiance.value", "sky.data", "sigma_t.value.value", ".g"
)  # fmt: skip


@pytest.fixture(autouse=True)
def nothing_recorded():
    frozen.forget_recordings()
    yield
    frozen.forget_recordings()


def _room() -> mi.Scene:
    pixels = np.random.default_rng(1).uniform(0.2, 0.8, (2, 3, 3))
    sky = np.random.default_rng(2).uniform(0.5, 1.5, (4, 8, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    place = mi.ScalarTransform4f().translate([0, 0, 2.5]).rotate([1, 0, 0], 180).scale(0.3)
    fog = {"type": "homogeneous", "sigma_t": 1.0, "phase": {"type": "hg", "g": 0.3}}
    ball = {"type": "sphere", "radius": 0.4}
    return mi.load_dict(
        stage(
            camera=sensor(film=film(12, 8, rfilter={"type": "gaussian"})),
            floor=rectangle(bsdf={"type": "diffuse", "reflectance": texture}),
            metal={**ball, "center": [-0.5, 0.2, 0.5],
                   "bsdf": {"type": "roughconductor", "alpha": 0.3}},
            fog={**ball, "center": [0.5, 0.2, 0.5], "bsdf": {"type": "null"}, "interior": fog},
            lamp=rectangle(place, emitter=area(8.0)),
            sky={"type": "envmap", "bitmap": mi.Bitmap(sky)},
        ),
        optimize=False,
    )  # fmt: skip


class _Optimization:
    """Steps of an optimization of logarithms of parameters."""

    def __init__(self) -> None:
        self.scene, self.logarithms = _room(), {}
        self.parameters = mi.traverse(self.scene)
        keys = [k for k in self.parameters.keys() if k.endswith(ENDS)]
        assert all(any(key.endswith(end) for key in keys) for end in ENDS)
        self.truth = {k: type(self.parameters[k])(self.parameters[k]) for k in keys}
        self.integrator = mi.load_dict({"type": "composed_prb", "max_depth": 4})

    def gradients(self, step: int, is_recorded: bool) -> list[np.ndarray]:
        logarithms = {key: value * 0 - 0.1 * step for key, value in self.truth.items()}
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, is_recorded):
            for key, value in logarithms.items():
                if step > 0:  # the first step has literals
                    dr.make_opaque(value)
                dr.enable_grad(value)
                self.parameters[key] = self.truth[key] * dr.exp(value)
            self.parameters.update()
            image = mi.render(
                self.scene, self.parameters, integrator=self.integrator, seed=step, spp=4
            )
            dr.backward(dr.mean(dr.square(image - 0.1), axis=None))
        return [np.array(dr.grad(value)).ravel() for value in logarithms.values()]


def _assert_equal(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    for ours, theirs in zip(found, expected):
        scale = np.abs(theirs).max()
        assert scale > 0
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4 * scale)


def test_recorded_gradients_agree_with_traced_ones(monkeypatch) -> None:
    """While parameters change. Mitsuba hides one of them, g, from Dr.Jit."""
    optimization, traced, trace = _Optimization(), [], Walk._trace
    monkeypatch.setattr(Walk, "_trace", lambda *args: traced.append(1) or trace(*args))
    found, counts = [], []
    for step in range(4):
        found.append(optimization.gradients(step, True))
        counts.append(len(traced))
    # The image and two walks for gradients, with literals and with arrays
    assert counts == [3, 6, 6, 6]
    for step in range(4):
        _assert_equal(found[step], optimization.gradients(step, False))


def test_passes_that_cannot_be_recorded_add_their_gradients_once(monkeypatch) -> None:
    again = ReplayedWalk.again

    def fail(*args: Any) -> Any:
        result = again(*args)
        if dr.flag(dr.JitFlag.FreezingScope):
            dr.eval()
            raise RuntimeError("record(): Tried to record a memcpy_async operation")
        return result

    scene = _room()
    parameters, integrator = mi.traverse(scene), mi.load_dict({"type": "composed_prb"})
    key = next(key for key in parameters.keys() if key.endswith("radiance.value"))

    def gradient() -> np.ndarray:
        parameters[key] = mi.Color3f(8)
        dr.enable_grad(parameters[key])
        parameters.update()
        dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator, spp=4)))
        return np.array(dr.grad(parameters[key])).ravel()

    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        expected = gradient()
    monkeypatch.setattr(ReplayedWalk, "again", fail)
    _assert_equal([gradient()], [expected])
