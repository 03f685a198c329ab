"""Recovers colours from an image: the colours of all materials in a house with 24 lamps
(``rooms``), or of walls that are lit through the gap of a door (``door_ajar``).

    python examples/inverse_rendering.py rooms

Mitsuba's ``prb`` computes the gradients, then ``composed_prb``, which learns where light comes
from, and then ``composed_prb`` in a ``control_variate``, whose images have less noise. All take as
many steps. Prints the error at the end, and writes a plot, ``inverse_rendering.png``, over the
seconds of all cores.
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
    seconds, errors, begin = [], [], time.process_time()
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
        seconds.append(time.process_time() - begin)
    return seconds, errors


def main(name: str = "rooms", steps: int = 250) -> None:
    """Optimizes with each integrator."""
    end, decisions, spp = TASKS[name]
    composed = {"type": "composed_prb", "max_depth": MAX_DEPTH, **decisions}
    integrators = {
        "prb": {"type": "prb", "max_depth": MAX_DEPTH},
        "composed_prb": composed,
        "composed_prb, control variate": {"type": "control_variate", "nested": composed},
    }
    for label, plugin in integrators.items():
        seconds, errors = recover(name, end, mi.load_dict(plugin), spp, steps)
        print(f"{label}: an error of {errors[-1]:.4f} after {seconds[-1]:.1f} s", flush=True)
        plt.semilogy(seconds, errors, label=label)
    plt.xlabel("seconds of all cores")
    plt.ylabel("mean error of a colour")
    plt.legend()
    plt.savefig("inverse_rendering.png", dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main(*sys.argv[1:2])
