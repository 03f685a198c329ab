"""How well are a million parameters recovered, compared with ``prb``? The textures of two rooms,
roughness, five lamps and an environment map, from 16 photographs.

    python benchmarks/textured_room.py --seconds 40

Each surface has a texture of its own. The photographs, of 96x54 pixels, are rendered by ``path``.
Each step renders one of them, and Adam moves all parameters, beginning with grey textures and lamps
of the same radiance. A texture is the sum of three levels of detail. All integrators get the same
processor time (of all cores; compilation and learning included).

Albedo: the mean error of the albedo of texels that are seen in a photograph. Roughness: the same.
Lamps: the mean error of the logarithms of their radiance. Sky: the mean error of its pixels.
Memory: the most that the process has held until then, photographs included.
"""

from __future__ import annotations

import itertools
import resource
import time
from collections.abc import Iterator

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip


_COMPOSED = {"type": "composed_prb", "max_depth": 6, "next_event": "contribution"}

INTEGRATORS = {
    "prb": {"type": "prb", "max_depth": 6},
    "defaults": {"type": "composed_prb", "max_depth": 6},
    "lights": _COMPOSED,
    "guide": {**_COMPOSED, "directions": "guided"},
    "loss": {**_COMPOSED, "gradient_samples": "loss"},
    "control": {"type": "control_variate", "nested": {**_COMPOSED, "learn_every": 0}},
}

#: Texels along the sides of textures and of the sky.
_TEXTURE, _SKY = 112, (64, 128)

#: The learning rates, relative to the rate of the albedo. Lamps have the longest way to go.
_RATES = {"albedo": 1.0, "roughness": 0.3, "lamps": 10.0, "sky": 5.0}

#: The values of each kind.
_LIMITS = {"albedo": (0.02, 0.98), "roughness": (0.02, 0.98), "sky": (0.01, 10.0)}

#: Widths of the texels of the levels of detail.
_LEVELS = 16, 4, 1


def _noise(shape: tuple[int, int], low: float, high: float, seed: int) -> np.ndarray:
    """Spots of random colours, without details as small as texels."""
    numbers, height, width = np.random.default_rng(seed), *shape
    image = np.zeros((height, width, 3))
    for count in (4, 12):
        grid = numbers.uniform(0, 1, (count, count, 3))
        rows, columns = (np.linspace(0, count - 1, size) for size in shape)
        image += np.stack([_stretched(grid[..., i], rows, columns) for i in range(3)], axis=2) / 2
    return (low + (high - low) * image).astype(np.float32)


def _stretched(grid: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    known = np.arange(len(grid))
    wide = np.array([np.interp(columns, known, row) for row in grid])
    return np.array([np.interp(rows, known, column) for column in wide.T]).T


def _bitmap(pixels: np.ndarray) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


class Room:
    """The two rooms. Walls and furniture stand along the axes.

    Attributes:
        described: The scene, for ``mi.load_dict``.
    """

    def __init__(self) -> None:
        self.described = {"type": "scene"}
        self._count = 0
        self._shell()
        self._furniture()
        for at, size, radiance in (
            ((2, 2, 2.69), 0.5, (7, 6, 5)), ((6, 1.2, 2.69), 0.3, (5, 6, 9)),
            ((0.3, 3.7, 1.6), 0.12, (40, 22, 10)), ((7.6, 0.4, 1.5), 0.1, (12, 30, 30)),
            ((1.0, 0.2, 0.6), 0.15, (20, 8, 6)),
        ):  # fmt: skip
            self._add(
                mi.ScalarTransform4f().translate(at).rotate([1, 0, 0], 180).scale(size),
                emitter={"type": "area", "radiance": {"type": "rgb", "value": radiance}},
            )
        sky = _noise(_SKY, 0.2, 3.0, 99) * np.linspace(1.5, 0.3, _SKY[0])[:, None, None]
        self.described["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32))}

    def _shell(self) -> None:
        for x in (0, 4):
            self._panel((x, 0, 0), (4, 4, 0), is_glossy=True)
            self._panel((x, 0, 2.7), (4, 4, 0))
            self._panel((x, 0, 0), (4, 0, 2.7))
        self._panel((0, 0, 0), (0, 4, 2.7))
        self._panel((8, 0, 0), (0, 4, 2.7))
        self._panel((0, 4, 0), (4, 0, 2.7))
        # A window
        for corner, size in (
            ((4, 4, 0), (4, 0, 0.8)), ((4, 4, 2.2), (4, 0, 0.5)),
            ((4, 4, 0.8), (0.8, 0, 1.4)), ((7.2, 4, 0.8), (0.8, 0, 1.4)),
        ):  # fmt: skip
            self._panel(corner, size)
        # A doorway
        for corner, size in (
            ((4, 0, 0), (0, 1.5, 2.7)), ((4, 2.5, 0), (0, 1.5, 2.7)), ((4, 1.5, 2.1), (0, 1, 0.6))
        ):  # fmt: skip
            self._panel(corner, size)

    def _furniture(self) -> None:
        T = mi.ScalarTransform4f
        for at, half in (
            ((1.2, 1.0, 0.4), (0.5, 0.4, 0.4)), ((0.5, 3.2, 0.6), (0.3, 0.5, 0.6)),
            ((3.2, 3.4, 0.35), (0.5, 0.35, 0.35)), ((6.2, 2.2, 0.4), (0.7, 0.5, 0.4)),
            ((7.4, 3.2, 0.8), (0.3, 0.4, 0.8)), ((4.6, 0.5, 0.45), (0.3, 0.3, 0.45)),
        ):  # fmt: skip
            self._add(T().translate(at).scale(half), "cube")
        for at, radius in (((1.2, 1.0, 1.1), 0.3), ((6.2, 2.2, 1.1), 0.3)):
            self._add(T().translate(at).scale(radius), "sphere", is_glossy=True)

    def _panel(self, corner: tuple, size: tuple, is_glossy: bool = False) -> None:
        """A rectangle along the axes; one entry of ``size`` is 0."""
        T, half = mi.ScalarTransform4f, np.array(size) / 2
        flat = int(np.argmin(half))
        turned = (T().rotate([0, 1, 0], 90), T().rotate([1, 0, 0], -90), T())[flat]
        half[flat] = 1
        place = T().translate(list(np.array(corner) + np.array(size) / 2)).scale(list(half))
        self._add(place @ turned, is_glossy=is_glossy)

    def _add(self, place, kind: str = "rectangle", is_glossy: bool = False, **parts) -> None:
        index, shape = self._count, (_TEXTURE, _TEXTURE)
        self._count += 1
        if not parts:
            colours = _bitmap(_noise(shape, 0.05, 0.9, index))
            bsdf = {"type": "diffuse", "reflectance": colours}
            if is_glossy:
                rough = _noise(shape, 0.1, 0.5, 1000 + index)[..., :1]
                bsdf = {"type": "principled", "base_color": colours, "specular": 0.5,
                        "roughness": _bitmap(np.ascontiguousarray(rough))}  # fmt: skip
            parts = {"bsdf": {"type": "twosided", "inside": bsdf}}
        self.described[f"surface{index}"] = {"type": kind, "to_world": place, **parts}


def cameras(size: tuple[int, int]) -> list[dict]:
    """Sixteen, eight in each room."""
    found = []
    for middle in (2.0, 6.0):
        for i in range(8):
            angle = 2 * np.pi * i / 8
            to = np.array([np.cos(angle), np.sin(angle), -0.25 if i % 2 else 0.15])
            at = np.array([middle, 2, 1.5]) - [1.2, 1.2, 0] * to
            place = mi.ScalarTransform4f().look_at(list(at), list(at + to), [0, 0, 1])
            found.append({
                "type": "perspective", "fov": 75, "to_world": place,
                "film": {"type": "hdrfilm", "width": size[0], "height": size[1],
                         "pixel_format": "rgb", "rfilter": {"type": "box"}},
            })  # fmt: skip
    return found


def kind_of(key: str) -> str:
    """What a parameter is."""
    if key.endswith("radiance.value"):
        return "lamps"
    return "sky" if key.startswith("sky") else "roughness" if "roughness" in key else "albedo"


class Unknown:
    """A parameter that is recovered.

    Parameters:
        key: Its name.
        truth: Its true value.
        optimizer: What optimizes it.
        rate: The learning rate of the albedo.
    """

    def __init__(self, key: str, truth, optimizer: mi.ad.Adam, rate: float) -> None:
        self.kind, self._shape, self._optimizer = kind_of(key), truth.shape, optimizer
        self._start = {"lamps": 10.0, "sky": 1.0}.get(self.kind, 0.4)
        self._levels = {key: None}
        if self.kind == "lamps":
            optimizer[key] = mi.Color3f(np.log(self._start))
        else:
            height, width, channels = self._shape
            self._levels = {
                f"{key}, {size}": (height // size, width // size, channels) for size in _LEVELS
            }
            for level, shape in self._levels.items():
                optimizer[level] = dr.zeros(mi.TensorXf, shape)
        for level in self._levels:
            optimizer.set_learning_rate({level: rate * _RATES[self.kind]})

    @property
    def value(self):
        """Its present value."""
        if self.kind == "lamps":
            (key,) = self._levels
            return dr.exp(self._optimizer[key])
        total = mi.TensorXf(self._start)
        for level, shape in self._levels.items():
            detail = self._optimizer[level]
            is_finest = shape == self._shape
            total = total + (detail if is_finest else dr.resample(detail, self._shape, "linear"))
        return dr.clip(total, *_LIMITS[self.kind])


class Recovery:
    """The task: the scene, its photographs, and what is recovered."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.scene = mi.load_dict(Room().described, optimize=False)
        self.parameters = mi.traverse(self.scene)
        self.truth = {
            key: type(value)(value) for key, value in self.parameters
            if key.endswith((".data", "radiance.value"))
        }  # fmt: skip
        self.sensors = [mi.load_dict(view) for view in cameras(size)]
        path = mi.load_dict({"type": "path", "max_depth": 6})
        self.photographs = [
            mi.render(self.scene, sensor=sensor, integrator=path, spp=512, seed=1000 + i)
            for i, sensor in enumerate(self.sensors)
        ]
        dr.eval(self.truth, self.photographs)
        self._seen = self._find_seen()

    def _find_seen(self) -> dict[str, np.ndarray]:
        """Whether each texel is seen in a photograph."""
        keys = [key for key in self.truth if kind_of(key) == "albedo"]
        for key in keys:
            dr.enable_grad(self.parameters[key])
            self.parameters.set_dirty(key)
        self.parameters.update()
        colours = mi.load_dict({"type": "aov", "aovs": "a:albedo"})
        for sensor in self.sensors:
            image = mi.render(self.scene, self.parameters, sensor, colours, spp=64)
            dr.backward(dr.sum(image, axis=None))
        seen = {key: np.array(dr.grad(self.parameters[key])).any(axis=2) for key in keys}
        self._reset()
        return seen | {key.replace("base_color", "roughness"): x for key, x in seen.items()}

    def _reset(self) -> None:
        for key, value in self.truth.items():
            self.parameters[key] = value
        self.parameters.update()

    def run(self, plugin: dict, seconds: float, rate: float, spp: int) -> Iterator[tuple]:
        """The time after each step, and a function that returns the errors."""
        integrator, optimizer = mi.load_dict(plugin), mi.ad.Adam(lr=rate)
        unknowns = {k: Unknown(k, truth, optimizer, rate) for k, truth in self.truth.items()}
        order, spent, step = np.random.default_rng(0), 0.0, 0
        while spent < seconds:
            begin = time.process_time()
            if step % len(self.sensors) == 0:
                turns = order.permutation(len(self.sensors))
            view = int(turns[step % len(self.sensors)])
            for key, unknown in unknowns.items():
                self.parameters[key] = unknown.value
            self.parameters.update()
            image = mi.render(
                self.scene, self.parameters, self.sensors[view], integrator, seed=step, spp=spp
            )
            target = self.photographs[view]
            loss = dr.mean(dr.square((image - target) / (target + 0.01)), axis=None)
            dr.backward(loss)
            optimizer.step()
            dr.eval(optimizer)
            dr.sync_thread()
            spent += time.process_time() - begin
            step += 1
            yield spent, lambda: self._errors(unknowns)
        self._reset()

    def _errors(self, unknowns: dict[str, Unknown]) -> dict[str, float]:
        differences: dict[str, list[np.ndarray]] = {}
        for key, unknown in unknowns.items():
            found, truth = np.array(dr.detach(unknown.value)), np.array(self.truth[key])
            if unknown.kind == "lamps":
                found, truth = np.log(found), np.log(truth)
            difference = np.abs(found - truth)[self._seen.get(key, ...)]
            differences.setdefault(unknown.kind, []).append(difference.ravel())
        return {kind: float(np.concatenate(x).mean()) for kind, x in differences.items()}


@click.command()
@click.option("--seconds", default=40.0, show_default=True, help="Of each optimization.")
@click.option("--size", default=(96, 54), type=(int, int), show_default=True)
@click.option("--spp", default=4, show_default=True, help="Samples per pixel of a step.")
@click.option("--rate", "rates", multiple=True, default=(0.005,), show_default=True, type=float,
              help="The learning rate of the albedo.")
@click.option("--integrator", "names", multiple=True, default=("prb", "lights"), show_default=True,
              type=click.Choice(list(INTEGRATORS)))
def main(seconds, size, spp, rates, names) -> None:
    """Runs the optimization with each integrator and each learning rate."""
    mi.set_variant("llvm_ad_rgb")
    recovery = Recovery(size)
    count = sum(int(np.prod(np.array(value).shape)) for value in recovery.truth.values())
    print(f"{count} parameters", flush=True)
    for rate, name in itertools.product(rates, names):
        report = seconds / 4
        for step, (spent, errors) in enumerate(
            recovery.run(INTEGRATORS[name], seconds, rate, spp), 1
        ):
            if spent >= report:
                report += seconds / 4
                listed = ", ".join(f"{kind} {x:.4f}" for kind, x in errors().items())
                print(f"{name}, rate {rate}: {spent:.0f} s, {step} steps: {listed}", flush=True)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"    {peak / 1024:.0f} MiB", flush=True)


if __name__ == "__main__":
    main()
