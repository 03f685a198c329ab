"""Whole optimizations, eight of them: how long do they take, compared with ``prb``?

    python benchmarks/recoveries.py --seconds 10

Each task recovers parameters of a scene from one picture of it, by Adam: colours, lamps, a
painting, roughness, an environment map, fog. All integrators take as many samples, have the same
learning rates, and get the same processor time (of all cores; learning included, kernels from the
cache on disk). In fog, ``prbvolpath`` stands for ``prb``.

Error: the mean over the parameters, of their difference to the true ones (of their logarithms for
lamps, roughness and fog), with the best of the learning rates. Speed: how much earlier the error
of an integrator stays at or below a level, which is the larger of its own final error and the final
error of ``prb``; errors are running means over a tenth of the steps. It is below 1 if ``prb`` is
the faster one. Where the error of either does not fall, there is no speed (``nan``).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

SCENES = Path(__file__).parents[1] / "scenes"

#: What is compared with ``prb``.
INTEGRATORS = {
    "composed_prb": {"type": "composed_prb", "max_depth": 6, "next_event": "contribution"},
    "control_variate": {"type": "control_variate", "max_depth": 6},
}


@dataclass
class Task:
    """What is recovered.

    Attributes:
        scene: Name of the scene.
        ends: The ends of the names of its parameters.
        start: Their values at the beginning; for logarithms, a factor of the true ones.
        is_logarithm: Whether their logarithms are optimized.
        spp: Samples per pixel of a step.
    """

    scene: str
    ends: tuple[str, ...]
    start: float = 0.4
    is_logarithm: bool = False
    spp: int = 2


TASKS = {
    "rooms, 20 colours": Task("rooms", ("reflectance.value",)),
    "cornell_box, 5 colours": Task("cornell_box", ("reflectance.value",)),
    "corridor, 7 colours": Task("corridor", ("reflectance.value",)),
    "rooms, 24 lamps": Task("rooms", ("radiance.value",), 2.0, True),
    "door_ajar, a painting": Task("door_ajar", ("reflectance.data",), 0.5, False, 4),
    "sunny_gloss, roughness": Task("sunny_gloss", ("alpha", "alpha.value"), 2.0, True, 4),
    "cornell_box, 16x8 sky": Task("sky", ("sky.data",), 0.5, False, 4),
    "cornell_box, fog": Task("fog", ("albedo.value.value", "sigma_t.value.value"), 2.0, True, 4),
}


def load(name: str, size: tuple[int, int]) -> mi.Scene:
    """A scene of the folder, or ``sky`` or ``fog``, with a film of this size."""
    if name in ("sky", "fog"):
        scene = mi.load_dict(_box(name), optimize=False)
    else:
        scene = mi.load_file(str(SCENES / f"{name}.xml"))
    sensor = mi.traverse(scene.sensors()[0])
    sensor["film.size"] = sensor["film.crop_size"] = list(size)
    sensor.update()
    return scene


def _box(name: str) -> dict:
    box = mi.cornell_box()
    del box["integrator"]
    if name == "sky":
        del box["light"], box["ceiling"]
        sky = np.random.default_rng(1).uniform(0.1, 1, (8, 16, 3)).astype(np.float32)
        box["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    else:
        medium = {
            "type": "homogeneous", "sigma_t": 1.5,
            "albedo": {"type": "rgb", "value": [0.8, 0.6, 0.4]},
        }  # fmt: skip
        box["ball"] = {
            "type": "sphere", "center": [0.1, -0.1, 0.35], "radius": 0.45,
            "bsdf": {"type": "null"}, "interior": medium,
        }  # fmt: skip
    return box


class Recovery:
    """A task with its scene and its picture."""

    def __init__(self, task: Task, size: tuple[int, int]) -> None:
        self.task, self.scene = task, load(task.scene, size)
        plugin = "volpath" if task.scene == "fog" else "path"
        reference = mi.load_dict({"type": plugin, "max_depth": 6})
        self.target = mi.render(self.scene, integrator=reference, spp=1024, seed=10**6)
        self.parameters = mi.traverse(self.scene)
        self.truth = {
            key: type(value)(value) for key, value in self.parameters
            if key.endswith(task.ends) and dr.is_diff_v(value)
        }  # fmt: skip
        dr.eval(self.target, self.truth)

    def run(self, plugin: dict, seconds: float, rate: float, seed: int) -> list[tuple]:
        """The time after each step, and the error."""
        task, integrator = self.task, mi.load_dict(plugin)
        optimizer, steps, spent = mi.ad.Adam(lr=rate), [], 0.0
        for key, value in self.truth.items():
            kind = type(value)
            if task.is_logarithm:
                optimizer[key] = kind(dr.log(value * task.start))
            else:
                optimizer[key] = kind(value * 0 + task.start)
        while spent < seconds:
            begin = time.process_time()
            for key in self.truth:
                self.parameters[key] = self._values(optimizer, key)
            self.parameters.update()
            image = mi.render(
                self.scene, self.parameters, integrator=integrator, seed=seed, spp=task.spp
            )
            loss = dr.mean(dr.square((image - self.target) / (self.target + 0.01)), axis=None)
            dr.backward(loss)
            optimizer.step()
            if not task.is_logarithm:
                for key in self.truth:
                    optimizer[key] = dr.clip(optimizer[key], 0.01, 0.99)
            dr.eval(optimizer)
            dr.sync_thread()
            spent += time.process_time() - begin
            steps.append((spent, self._error(optimizer)))
            seed += 1
        for key, value in self.truth.items():
            self.parameters[key] = value
        self.parameters.update()
        return steps

    def runs(
        self, plugins: dict[str, dict], seconds: float, rates: tuple[float, ...], seeds: int
    ) -> dict[str, list[list[tuple]]]:
        """For each plugin, a run with each of the seeds, with the best of the learning rates.
        Plugins take turns, because the load of the machine changes. A short run of each one comes
        first, which compiles."""
        for plugin in plugins.values():
            self.run(plugin, 1.0, rates[0], 0)
        found = {(name, rate): [] for name in plugins for rate in rates}
        for seed in range(seeds):
            for name, rate in found:
                steps = self.run(plugins[name], seconds, rate, 10**4 * seed)
                found[name, rate].append(steps)
        return {
            name: min((found[name, rate] for rate in rates), key=final_error) for name in plugins
        }

    def _values(self, optimizer: mi.ad.Adam, key: str):
        if not self.task.is_logarithm:
            return optimizer[key]
        value = dr.exp(optimizer[key])
        return dr.minimum(value, 0.99) if "albedo" in key else value

    def _error(self, optimizer: mi.ad.Adam) -> float:
        errors = []
        for key, truth in self.truth.items():
            found = np.array(dr.detach(self._values(optimizer, key)))
            truth = np.array(truth)
            if self.task.is_logarithm:
                found, truth = np.log(found), np.log(truth)
            errors.append(np.abs(found - truth).mean())
        return float(np.mean(errors))


def smoothed(steps: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """The times, and a running mean of the errors."""
    times, errors = np.array(steps).T
    width = max(1, len(errors) // 10)
    sums = np.cumsum(np.concatenate([np.full(width, errors[0]), errors]))
    return times, (sums[width:] - sums[:-width]) / width


def final_error(runs: list[list[tuple]]) -> float:
    """The mean error at the end."""
    return float(np.mean([smoothed(steps)[1][-1] for steps in runs]))


def described(runs: list[list[tuple]]) -> str:
    """The error at the end, and the number of steps."""
    return f"{final_error(runs):.4f} ({int(np.mean([len(steps) for steps in runs]))} steps)"


def speed(ours: list[tuple], theirs: list[tuple]) -> float:
    """How much earlier the error of ``ours`` stays at or below the larger of the two final
    errors; not a number if that is not below the first error."""
    curves = [smoothed(each) for each in (ours, theirs)]
    level = max(errors[-1] for _, errors in curves)
    if level >= min(errors[0] for _, errors in curves):
        return math.nan
    first, second = (times[np.flatnonzero(errors > level)[-1] + 1] for times, errors in curves)
    return float(second / first)


def mean_speed(speeds: list[float]) -> float:
    """The geometric mean of those that are numbers."""
    known = [each for each in speeds if not math.isnan(each)]
    return math.exp(np.mean(np.log(known))) if known else math.nan


@click.command()
@click.option("--seconds", default=10.0, show_default=True, help="Of each optimization.")
@click.option("--size", default=(64, 36), type=(int, int), show_default=True)
@click.option("--rate", "rates", multiple=True, default=(0.02,), show_default=True, type=float)
@click.option("--seeds", default=3, show_default=True, help="Optimizations of each integrator.")
@click.option("--only", default="", help="Tasks whose names contain this.")
@click.option("--against", "names", multiple=True, default=tuple(INTEGRATORS), show_default=True,
              type=click.Choice(list(INTEGRATORS)))
def main(
    seconds: float, size: tuple[int, int], rates: tuple[float, ...], seeds: int, only: str,
    names: tuple[str, ...],
) -> None:  # fmt: skip
    """Runs the tasks with each integrator, each learning rate and each seed."""
    mi.set_variant("llvm_ad_rgb")
    means: dict[str, list[float]] = {name: [] for name in names}
    for name, task in TASKS.items():
        if only not in name:
            continue
        recovery = Recovery(task, size)
        prb = {"type": "prbvolpath" if task.scene == "fog" else "prb", "max_depth": 6}
        plugins = {"prb": prb, **{each: INTEGRATORS[each] for each in names}}
        runs = recovery.runs(plugins, seconds, rates, seeds)
        start = runs["prb"][0][0][1]
        print(f"{name}: error {start:.3f} -> prb {described(runs['prb'])}", end="", flush=True)
        for each in names:
            speeds = [speed(*pair) for pair in zip(runs[each], runs["prb"])]
            means[each].append(mean_speed(speeds))
            listed = ", ".join(f"{x:.2f}" for x in speeds)
            print(f"; {each} {described(runs[each])}, speed {means[each][-1]:.2f} ({listed})",
                  end="", flush=True)  # fmt: skip
        print(flush=True)
    for each, values in means.items():
        print(f"{each}: geometric mean {mean_speed(values):.2f}, least {np.nanmin(values):.2f}")


if __name__ == "__main__":
    main()
