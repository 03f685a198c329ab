"""Do control variates pay in an optimization? ``control_variate`` around ``prb`` and
``composed_prb``, and both without it.

    python benchmarks/optimizations.py scenes/rooms.xml scenes/cornell_box.xml --seconds 30

Recovers the colours of all materials of each scene, beginning with grey, from a picture of the
scene, by Adam, with the loss of ``examples/inverse_rendering.py``. All integrators get the same
time (of all cores).
Colours: the mean error of a colour channel, a mean over the last tenth of the steps.
Image: the error of the image, relative to the error of the same integrator's own render with as
many samples, at the same parameters (relative squared error against a reference, a geometric mean
over two times).
"""

from __future__ import annotations

import time
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

_PRB = {"type": "prb", "max_depth": 6}
_COMPOSED = {"type": "composed_prb", "max_depth": 6, "next_event": "contribution"}

INTEGRATORS = {
    "prb": _PRB,
    "prb, control variate": {"type": "control_variate", "nested": _PRB},
    "composed_prb": _COMPOSED,
    "composed_prb, control variate": {"type": "control_variate", "nested": _COMPOSED},
}

#: When the error of the image is measured, as shares of the time.
_CHECKS = (0.3, 0.9)


def squared_error(image: mi.TensorXf, reference: mi.TensorXf) -> float:
    """The relative squared error, of the 99 % of the pixels in which it is least."""
    reference = np.array(reference)
    error = np.square(np.array(image) - reference) / (np.square(reference) + 0.01)
    error = np.sort(error.mean(axis=2).ravel())
    return float(error[: -max(1, len(error) // 100)].mean())


class Optimization:
    """Recovers the colours of a scene."""

    def __init__(self, file: Path, size: tuple[int, int], start: float) -> None:
        self.scene = mi.load_file(str(file))
        sensor = mi.traverse(self.scene.sensors()[0])
        sensor["film.size"] = sensor["film.crop_size"] = list(size)
        sensor.update()
        auto = mi.load_dict({"type": "auto", "max_depth": 6})
        self.target = mi.render(self.scene, integrator=auto, spp=512)
        self.parameters = mi.traverse(self.scene)
        # No grey values, which are floats
        self.truth = {
            key: mi.Color3f(value)
            for key, value in self.parameters
            if key.endswith("reflectance.value") and isinstance(value, mi.Color3f)
        }
        dr.eval(self.target, self.truth)
        self._start = start

    def run(
        self, integrator: mi.Integrator, spp: int, seconds: float, rate: float, seed: int
    ) -> tuple[list[float], list[float], list[float]]:
        """The seconds after each step, the errors of the colours, and the errors of the image
        relative to a render of its own (if the integrator is nested)."""
        optimizer = mi.ad.Adam(lr=rate)
        for key in self.truth:
            optimizer[key] = mi.Color3f(self._start)
        times, colours, images, spent = [], [], [], 0.0
        while spent < seconds:
            begin = time.process_time()
            self.parameters.update(optimizer)
            image = mi.render(
                self.scene, self.parameters, integrator=integrator, seed=seed, spp=spp
            )
            loss = dr.mean(dr.square((image - self.target) / (self.target + 0.01)), axis=None)
            dr.backward(loss)
            optimizer.step()
            for key in self.truth:
                optimizer[key] = dr.clip(optimizer[key], 0.01, 0.99)
            dr.eval(optimizer)
            dr.sync_thread()
            spent += time.process_time() - begin
            if len(images) < len(_CHECKS) and spent > _CHECKS[len(images)] * seconds:
                images.append(self._relative_error(image, integrator, spp, seed))
            error = [float(dr.mean(dr.abs(optimizer[k] - x))[0]) for k, x in self.truth.items()]
            times.append(spent)
            colours.append(float(np.mean(error)))
            seed += 1
        return times, colours, images

    def _relative_error(self, image, integrator, spp: int, seed: int) -> float:
        nested = getattr(integrator, "nested", None)
        if nested is None:
            return 1.0
        with dr.suspend_grad():
            auto = mi.load_dict({"type": "auto", "max_depth": 6})
            reference = auto.render(self.scene, spp=512, seed=seed + 1)
            single = nested.render(self.scene, spp=spp, seed=seed + 10**6)
        return squared_error(image, reference) / squared_error(single, reference)


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--spp", default=2, show_default=True)
@click.option("--seconds", default=30.0, show_default=True)
@click.option("--runs", default=2, show_default=True, help="Runs with seeds of their own.")
@click.option("--rate", default=0.02, show_default=True, help="Learning rate of Adam.")
@click.option("--start", default=0.4, show_default=True, help="The colours at the beginning.")
@click.option("--size", default=(96, 54), type=(int, int), show_default=True)
@click.option("--plot", type=click.Path(path_type=Path), help="File for a plot of the first run.")
def main(files, spp, seconds, runs, rate, start, size, plot) -> None:
    """Compares on the scenes FILES."""
    mi.set_variant("llvm_ad_rgb")
    curves = {}
    for file in files:
        optimization = Optimization(file, size, start)
        print(f"{file.stem}, {len(optimization.truth)} colours", flush=True)
        for name, plugin in INTEGRATORS.items():
            ends, counts, images = [], [], []
            for run in range(runs):
                integrator = mi.load_dict(plugin)
                times, colours, relative = optimization.run(
                    integrator, spp, seconds, rate, 1 + run * 10**5
                )
                ends.append(np.mean(colours[-(len(colours) // 10 + 1) :]))
                counts.append(len(times))
                images += relative
                curves.setdefault((file.stem, name), (times, colours))
            print(
                f"    {name}: colours {np.mean(ends):.4f} (from {np.min(ends):.4f} to "
                f"{np.max(ends):.4f}), {np.mean(counts):.0f} steps, "
                f"image {np.exp(np.mean(np.log(images))):.3f}",
                flush=True,
            )
    if plot:
        _draw(curves, plot)


def _draw(curves: dict, file: Path) -> None:
    import matplotlib.pyplot as plt

    scenes = list(dict.fromkeys(scene for scene, _ in curves))
    figure, axes = plt.subplots(1, len(scenes), figsize=(3.6 * len(scenes), 3.2), squeeze=False)
    for axis, scene in zip(axes[0], scenes):
        for name in INTEGRATORS:
            axis.semilogy(*curves[scene, name], label=name)
        axis.set_title(scene)
        axis.set_xlabel("seconds")
    axes[0][0].set_ylabel("mean error of a colour")
    axes[0][0].legend(fontsize=8)
    figure.savefig(file, dpi=100, bbox_inches="tight")


if __name__ == "__main__":
    main()
