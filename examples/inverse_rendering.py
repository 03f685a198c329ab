"""Recovers colours from an image: the colours of all materials in a house with 24 lamps
(``rooms``), or of walls that are lit through the gap of a door (``door_ajar``).

    python examples/inverse_rendering.py rooms

``composed_prb``, which learns where light comes from, computes the gradients; for comparison,
Mitsuba's ``prb`` then takes as many steps. Prints the error at the end, and writes a plot,
``inverse_rendering.png``.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import matplotlib.pyplot as plt

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses an LLVM library that works)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"
SIZE, MAX_DEPTH, START = (96, 54), 6, 0.4

#: For each scene: the end of the names of what is recovered, the decisions of ``composed_prb``, and
#: the samples per pixel of a step.
TASKS = {
    "rooms": ("reflectance.value", {"next_event": "contribution"}, 2),
    "door_ajar": (
        "wall.brdf_0.reflectance.value",
        {"directions": "guided", "next_event": "contribution"},
        16,
    ),
}

mi.set_variant("llvm_ad_rgb")


def recover(
    name: str, end: str, integrator: mi.Integrator, spp: int, steps: int
) -> tuple[list[float], list[float]]:
    """The seconds until each step, and the mean error of the colours after it."""
    scene = mi.load_file(str(SCENES / f"{name}.xml"), width=SIZE[0], height=SIZE[1])
    auto = mi.load_dict({"type": "auto", "max_depth": MAX_DEPTH})
    target = mi.render(scene, integrator=auto, spp=1024)
    parameters = mi.traverse(scene)
    truth = {key: mi.Color3f(value) for key, value in parameters if key.endswith(end)}
    dr.eval(target, truth)
    optimizer = mi.ad.Adam(lr=0.02)
    for key in truth:
        optimizer[key] = mi.Color3f(START)
    seconds, errors, begin = [], [], time.perf_counter()
    for step in range(steps):
        parameters.update(optimizer)
        image = mi.render(scene, parameters, integrator=integrator, seed=step, spp=spp)
        loss = dr.mean(dr.square((image - target) / (target + 0.01)), axis=None)
        dr.backward(loss)
        optimizer.step()
        error = 0.0
        for key, true in truth.items():
            optimizer[key] = dr.clip(optimizer[key], 0.01, 0.99)
            error += float(dr.mean(dr.abs(optimizer[key] - true))[0])
        errors.append(error / len(truth))
        seconds.append(time.perf_counter() - begin)
    return seconds, errors


def main(name: str = "rooms", steps: int = 250) -> None:
    """Optimizes with both integrators."""
    end, decisions, spp = TASKS[name]
    for plugin, more in (("prb", {}), ("composed_prb", decisions)):
        integrator = mi.load_dict({"type": plugin, "max_depth": MAX_DEPTH, **more})
        seconds, errors = recover(name, end, integrator, spp, steps)
        print(f"{plugin}: an error of {errors[-1]:.4f} after {seconds[-1]:.1f} s", flush=True)
        plt.semilogy(seconds, errors, label=plugin)
    plt.xlabel("seconds")
    plt.ylabel("mean error of a colour")
    plt.legend()
    plt.savefig("inverse_rendering.png", dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main(*sys.argv[1:2])
