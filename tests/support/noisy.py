"""Integrators with known error and time, and comparisons of them.

Times come from a clock that the integrators advance themselves.
"""

from __future__ import annotations

import itertools

import numpy as np

from mitsuba_ext import compare
from mitsuba_ext.compare.experiment import run_seed

import mitsuba as mi  # isort: skip

#: A scene whose image is 1 everywhere, whatever the integrator.
WHITE = {
    "type": "scene",
    "integrator": {"type": "path", "max_depth": 3},
    "sensor": {
        "type": "perspective",
        "film": {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}},
    },
    "emitter": {"type": "constant"},
}


#: Numbers the integrators under test.
COUNT = itertools.count()


def noisy_integrator(
    clock, sigma=1.0, cost=0.01, fixed=0.0, fails_in=None, mean=1.0, calls=None, is_shared=False
):
    """Renders ``mean`` with noise of variance σ²/spp, and takes ``fixed + cost · spp`` seconds. All
    pixels have the same noise where it ``is_shared``."""

    class Noisy(type(mi.load_dict({"type": "prb"}))):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if calls is not None:
                calls.append((int(seed), spp))
            if fails_in is not None and seed == run_seed(0, fails_in) and spp > 3:
                raise ZeroDivisionError("no\nlight")
            clock.now += clock.slowness * (fixed + cost * spp)
            width, height = scene.sensors()[0].film().crop_size()
            noise = np.random.default_rng([int(seed), spp, int(sigma * 1e6)])
            shape = (int(height), int(width), 3)
            values = noise.standard_normal((1, 1, 1) if is_shared else shape)
            return mi.TensorXf(np.broadcast_to(mean + sigma * spp**-0.5 * values, shape).copy())

        def to_string(self):
            return f"Noisy[{sigma}, {cost}, {fixed}, {mean}]"

    name = f"noisy{next(COUNT)}"
    mi.register_integrator(name, Noisy)
    return name


def compare_noisy(budget, integrators, tmp_path, reference_spp=16, seeds=3):
    """Compares integrators on :data:`WHITE` against its image; the record of the scene."""
    path = tmp_path / "reference.exr"
    truth = np.concatenate([np.ones((24, 32, 3)), np.zeros((24, 32, 3))], axis=2)
    channels = [f"{name}.{color}" for name in ("mean", "variance") for color in "RGB"]
    compare.write_exr(path, truth, channels, {"spp": reference_spp})
    setup = compare.SceneSetup(WHITE, reference=path)
    comparison = compare.Comparison(setup, integrators, budget, seeds=seeds, folder=tmp_path)
    return comparison.run()["scenes"][0]
