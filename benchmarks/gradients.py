"""How noisy are gradients, and how long do they take? ``composed_prb`` against Mitsuba's ``prb``,
or ``prbvolpath`` in scenes with media.

    python benchmarks/gradients.py scenes/rooms.xml --spp 64
    python benchmarks/in_fog.py scenes/rooms.xml 0.05 --clear 0.1
    python benchmarks/gradients.py scenes/rooms_in_fog.xml --spp 64

The loss is the mean of the image, weighted by random numbers / (1 + radiance); with ``--loss
squared``, by the derivative of a squared error that was measured with 16 samples per pixel; with
``--loss masked``, by random numbers in the middle quarter of the image alone. Its gradients are
those with respect to all colours (except black ones), roughnesses and emissions of the scene that
are no textures, and to the albedo and extinction of media;
with ``--roughness``, with respect to roughnesses alone;
with ``--lamps``, with respect to the emission of one of the lamps alone;
with ``--singles``, with respect to one of the parameters alone.
Variance: the geometric mean, over these parameters, of the variance between seeds. Time: the median
over the renders but the first two, of the image and its gradients, of all cores; learning included.
z: the difference of the means to those of ``prb``, in units of its standard error. In brackets: the
same from the squared distance between the quartiles, on which rare large values have no effect.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

from mitsuba_ext.scene.media import has_media  # isort: skip

_ENDS = ("reflectance.value", "radiance.value", "alpha.value", "albedo.value.value",
         "sigma_t.value.value")  # fmt: skip

_ROUGHNESS = ("alpha", "alpha.value", "roughness.value")

#: The first one, in scenes with media the second, is that to which the others are compared.
INTEGRATORS = {
    "prb": {"type": "prb"},
    "prbvolpath": {"type": "prbvolpath"},
    "composed_prb": {"type": "composed_prb"},
    "loss samples": {"type": "composed_prb", "gradient_samples": "loss"},
    "lights": {"type": "composed_prb", "next_event": "contribution"},
    "guide and lights": {
        "type": "composed_prb", "next_event": "contribution", "directions": "guided"
    },
}  # fmt: skip


def gradients(scene, parameters, keys, integrator, weights, spp: int, seed: int):
    """The sum over the channels of each parameter's gradient, and the CPU time."""
    for key in keys:
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
    begin = time.process_time()
    image = mi.render(
        scene, parameters, integrator=integrator, seed=seed, seed_grad=seed + 10000, spp=spp
    )
    dr.backward(dr.mean(image * weights, axis=None))
    found = [np.array(dr.grad(parameters[key])).sum() for key in keys]
    return found, time.process_time() - begin


def load(
    file: Path, size: tuple[int, int], loss: str = "even"
) -> tuple[mi.Scene, mi.SceneParameters, mi.TensorXf]:
    """The scene, its parameters, and the weights of the loss."""
    scene = mi.load_file(str(file))
    sensor = mi.traverse(scene.sensors()[0])
    sensor["film.size"] = sensor["film.crop_size"] = list(size)
    sensor.update()
    random = np.random.default_rng(1).uniform(0.5, 1.5, (*size[::-1], 3))
    plugin = "composed_path" if has_media(scene) else "bdpt"
    mean = mi.render(scene, integrator=mi.load_dict({"type": plugin, "max_depth": 6}), spp=64)
    weights = random / (1 + np.array(mean))
    if loss == "squared":
        path = mi.load_dict({"type": "composed_path", "max_depth": 6})
        weights = np.array(mi.render(scene, integrator=path, spp=16, seed=1)) - 0.8 * np.array(mean)
    if loss == "masked":
        y, x = (np.abs(np.linspace(-1, 1, n)) < 0.5 for n in size[::-1])
        weights = random * y[:, None, None] * x[:, None]
    return scene, mi.traverse(scene), mi.TensorXf(weights.astype(np.float32))


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--spp", default=64, show_default=True)
@click.option("--seeds", default=16, show_default=True)
@click.option("--size", default=(128, 72), type=(int, int), show_default=True)
@click.option(
    "--loss", default="even", show_default=True, type=click.Choice(["even", "squared", "masked"])
)
@click.option("--roughness", is_flag=True, help="Only of roughness.")
@click.option("--lamps", default=0, help="Of so many lamps, each on its own, in scenes with more.")
@click.option("--singles", default=0, help="Of so many parameters, each on its own.")
def main(
    files: tuple[Path, ...], spp: int, seeds: int, size: tuple[int, int], loss: str,
    roughness: bool, lamps: int, singles: int,
) -> None:  # fmt: skip
    """Compares on the scenes FILES."""
    mi.set_variant("llvm_ad_rgb")
    for file in files:
        scene, parameters, weights = load(file, size, loss)
        ends = _ROUGHNESS if roughness else _ENDS
        # Black things have gradients of noise alone
        keys = [
            key for key in parameters.keys()
            if key.endswith(ends) and np.any(np.array(parameters[key]) != 0)
        ]  # fmt: skip
        sets = [keys]
        if lamps or singles:
            alone = [[key] for key in keys if singles or key.endswith("radiance.value")]
            sets = alone[:: -(-len(alone) // (singles or lamps))]
        print(f"{file}, {spp} spp, {sum(map(len, sets))} parameters", flush=True)
        known = None
        unused = "prb" if has_media(scene) else "prbvolpath"
        for first, (name, plugin) in enumerate(INTEGRATORS.items()):
            if name == unused:
                continue
            found, times = [[] for _ in sets], []
            for index, wanted in enumerate(sets):
                integrator = mi.load_dict({**plugin, "max_depth": 6})
                dr.disable_grad([parameters[key] for key in keys])
                for seed in range(1000 * first, 1000 * first + seeds):
                    values, seconds = gradients(
                        scene, parameters, wanted, integrator, weights, spp, seed
                    )
                    found[index].append(values)
                    times.append(seconds)
            samples = np.concatenate(found, axis=1)
            mean, variance = np.mean(samples, axis=0), np.var(samples, axis=0, ddof=1)
            taken = statistics.median(times[2:])
            spread = np.square(np.subtract(*np.quantile(samples, (0.75, 0.25), axis=0)))
            known = known or (mean, variance, taken, spread)
            # Lights and materials that no path finds have neither gradients nor noise
            is_noisy = np.minimum(known[1], variance) > 1e-20
            is_noisy &= np.minimum(known[3], spread) > 0
            error = np.sqrt((variance + known[1]) / seeds)[is_noisy]
            z = np.abs(mean - known[0])[is_noisy] / error
            ratio, middle = (
                np.exp(np.mean(np.log(x[is_noisy] / y[is_noisy])))
                for x, y in ((variance, known[1]), (spread, known[3]))
            )
            speed = known[2] / taken
            print(
                f"    {name}: variance {ratio:.2f} ({middle:.2f}), time {1 / speed:.2f}, "
                f"efficiency {speed / ratio:.2f} ({speed / middle:.2f}); "
                f"|z| median {np.median(z):.1f}, largest {z.max():.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
