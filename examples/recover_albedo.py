"""Recovers the colour of the walls of a room that is lit through the gap of a door, from an image.

Gradients are those of ``composed_prb``, which learns where light comes from; for comparison, the
same number of steps with Mitsuba's ``prb``. Prints the colours that are found, and writes a plot,
``recover_albedo.png``.
"""

from __future__ import annotations

import time
from pathlib import Path

import matplotlib.pyplot as plt

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses an LLVM library that works)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SCENE = Path(__file__).parents[1] / "scenes" / "door_ajar.xml"
WALL = "wall.brdf_0.reflectance.value"
SIZE, SPP = (96, 54), 16

mi.set_variant("llvm_ad_rgb")


def recover(
    name: str, target: mi.TensorXf, truth: mi.Color3f, steps: int
) -> tuple[list[float], list[float], mi.Color3f]:
    """The seconds until each step, the error of the colour after it, and the colour in the end."""
    scene = mi.load_file(str(SCENE), width=SIZE[0], height=SIZE[1])
    parameters = mi.traverse(scene)
    integrator = mi.load_dict({"type": name, "max_depth": 8, **INTEGRATORS[name]})
    optimizer = mi.ad.Adam(lr=0.02)
    optimizer[WALL] = mi.Color3f(0.3, 0.3, 0.3)
    parameters.update(optimizer)
    seconds, errors, begin = [], [], time.perf_counter()
    for step in range(steps):
        image = mi.render(scene, parameters, integrator=integrator, seed=step, spp=SPP)
        loss = dr.mean(dr.square(image - target) / (target + 0.01), axis=None)
        dr.backward(loss)
        optimizer.step()
        optimizer[WALL] = dr.clip(optimizer[WALL], 0.01, 0.99)
        parameters.update(optimizer)
        errors.append(float(dr.mean(dr.abs(optimizer[WALL] - truth))[0]))
        seconds.append(time.perf_counter() - begin)
    return seconds, errors, dr.detach(optimizer[WALL])


INTEGRATORS = {
    "prb": {},
    "composed_prb": {"directions": "guided", "next_event": "contribution"},
}


def main(steps: int = 60) -> None:
    """Optimizes with both integrators."""
    scene = mi.load_file(str(SCENE), width=SIZE[0], height=SIZE[1])
    truth = mi.Color3f(mi.traverse(scene)[WALL])
    print("to find:", truth)
    target = mi.render(scene, integrator=mi.load_dict({"type": "auto", "max_depth": 8}), spp=1024)
    for name in INTEGRATORS:
        seconds, errors, found = recover(name, target, truth, steps)
        print(f"{name}: {found} after {seconds[-1]:.1f} s")
        plt.semilogy(seconds, errors, label=name)
    plt.xlabel("seconds")
    plt.ylabel("mean error of the colour")
    plt.legend()
    plt.savefig("recover_albedo.png", dpi=120)


if __name__ == "__main__":
    main()
