"""Renders with an integrator in two threads at once, in a process of its own (a crash must not end
the tests). ``python -m tests.support.two_threads SHARED ROUNDS INTEGRATOR…`` exits with 1 if an
image differs from the one of a render alone.

SHARED is what the two renders share: ``nothing``, the ``scene``, the scene and its ``film``, or all
of these and the ``integrator``.
"""

from __future__ import annotations

import sys
import threading
from typing import Any

import tests.support.quick_kernels  # noqa: F401  isort: skip  (before drjit)
import mitsuba_ext  # noqa: F401
from mitsuba_ext.transport.frozen import forget_recordings

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

_SIZE, _SPP, _SEEDS = 12, 8, (1, 2)


def _camera() -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": _SIZE, "height": _SIZE, "rfilter": {"type": "box"}}
    return {
        "type": "perspective", "fov": 40, "film": film, "sampler": {"type": "independent"},
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 3.9], [0, 0, 0], [0, 1, 0]),
    }  # fmt: skip


def _scene(roughness: float) -> mi.Scene:
    box = mi.cornell_box()
    box["large-box"]["bsdf"] = {"type": "roughconductor", "alpha": roughness}
    del box["integrator"]
    return mi.load_dict({**box, "sensor": _camera()})


def _differences(shared: str, rounds: int, name: str) -> list[str]:
    first = _scene(0.2)
    scenes = [first, _scene(0.4) if shared == "nothing" else first]
    integrators = [mi.load_dict({"type": name, "max_depth": 4}) for _ in _SEEDS]
    if shared == "integrator":
        integrators[1] = integrators[0]
    sensors = [scene.sensors()[0] for scene in scenes]
    if shared == "scene":
        sensors[1] = mi.load_dict(_camera())

    def image(thread: int) -> np.ndarray:
        parts = scenes[thread], sensors[thread], _SEEDS[thread]
        return np.array(integrators[thread].render(*parts, spp=_SPP))

    alone = [image(thread) for thread in (0, 1)]
    found = []
    for number in range(rounds):
        together: list[Any] = ["no image"] * 2

        def render(thread: int, images: list[Any] = together) -> None:
            try:
                images[thread] = image(thread)
            except Exception as failure:
                images[thread] = repr(failure)

        threads = [threading.Thread(target=render, args=(thread,)) for thread in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for thread, (one, other) in enumerate(zip(alone, together)):
            if isinstance(other, str):
                found.append(f"{name}, round {number}, thread {thread}: {other}")
            elif not np.allclose(one, other, rtol=1e-5, atol=1e-6 * one.max()):
                share = np.abs(one - other).max() / one.max()
                found.append(f"{name}, round {number}, thread {thread}: differs by {share:.2g}")
    return found


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    sys.setswitchinterval(1e-4)  # the threads change more often
    differences = []
    for name in sys.argv[3:]:
        differences += _differences(sys.argv[1], int(sys.argv[2]), name)
        forget_recordings()
    print("\n".join(differences))
    sys.exit(bool(differences))
