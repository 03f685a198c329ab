"""How well are a million parameters recovered, compared with ``prb``? The textures of two rooms,
roughness, five lamps and an environment map, from 16 photographs.

    python benchmarks/textured_room.py --seconds 120

Each surface has a texture of its own. The photographs, of 96x54 pixels, are rendered by ``path``.
Each step shows one of them (or all, with ``--batch``), and Adam moves all parameters, beginning
with grey textures and lamps of the same radiance. All integrators get the same processor time (of
all cores; compilation and learning included).

Albedo: the mean error of the albedo of texels that are seen in a photograph. Roughness: the same.
Lamps: the mean error of the logarithms of their radiance. Sky: the mean error of its pixels.
Memory: the most that the process has held until then.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip



_COMPOSED = {"type": "composed_prb", "next_event": "contribution"}

INTEGRATORS = {
    "prb": {"type": "prb"},
    "defaults": {"type": "composed_prb"},
    "lights": _COMPOSED,
    "loss": {**_COMPOSED, "gradient_samples": "loss"},
    "control": {"type": "control_variate", "nested": {**_COMPOSED, "learn_every": 0}},
}

#: Texels along the sides of textures and of the sky, and the depth of paths.
_TEXTURE, _SKY, _MAX_DEPTH = 112, (64, 128), 6

#: The learning rates of roughness, lamps and sky, relative to the rate of the albedo.
_RATES = {"alpha": 1.0, "radiance": 1.0, "sky": 1.0}


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


class Recovery:
    """The task: the scene, its photographs, and what is recovered."""

    def __init__(self, size: tuple[int, int], is_batch: bool) -> None:
        self.scene = mi.load_dict(Room().described, optimize=False)
        self.parameters = mi.traverse(self.scene)
        self.truth = {
            key: type(value)(value) for key, value in self.parameters
            if key.endswith((".data", "radiance.value"))
        }  # fmt: skip
        views = cameras(size)
        if is_batch:
            film = {**views[0]["film"], "width": size[0] * len(views)}
            each = {f"view{i}": view for i, view in enumerate(views)}
            views = [{"type": "batch", "film": film, **each}]
        self.sensors = [mi.load_dict(view) for view in views]
        path = mi.load_dict({"type": "path", "max_depth": _MAX_DEPTH})
        self.photographs = [
            mi.render(self.scene, sensor=sensor, integrator=path, spp=512, seed=1000 + i)
            for i, sensor in enumerate(self.sensors)
        ]
        dr.eval(self.truth, self.photographs)
        self._seen = self._find_seen()

    def _find_seen(self) -> dict[str, np.ndarray]:
        """Whether each texel is seen in a photograph."""
        keys = [key for key in self.truth if key.startswith("surface") and key.endswith(".data")]
        for key in keys:
            dr.enable_grad(self.parameters[key])
            self.parameters.set_dirty(key)
        self.parameters.update()
        colours = mi.load_dict({"type": "aov", "aovs": "a:albedo"})
        for sensor in self.sensors:
            image = mi.render(self.scene, self.parameters, sensor=sensor, integrator=colours, spp=64)
            dr.backward(dr.sum(image, axis=None))
        seen = {key: np.array(dr.grad(self.parameters[key])).any(axis=2) for key in keys}
        for key in keys:
            rough = key.replace("roughness", "base_color")
            seen[key] = seen[rough]
            self.parameters[key] = self.truth[key]
        self.parameters.update()
        return seen

    def run(self, plugin: dict, seconds: float, rate: float, spp: int, seed: int) -> Iterator[tuple]:
        """The time after each step, and the errors."""
        nested = plugin.get("nested")
        plugin = {**plugin, "max_depth": _MAX_DEPTH} if nested is None else {
            **plugin, "nested": {**nested, "max_depth": _MAX_DEPTH}}
        integrator, optimizer = mi.load_dict(plugin), mi.ad.Adam(lr=rate)
        for key, value in self.truth.items():
            optimizer[key] = self._start(key, value)
        order, spent, step = np.random.default_rng(seed), 0.0, 0
        while spent < seconds:
            begin = time.process_time()
            if step % len(self.sensors) == 0:
                turns = order.permutation(len(self.sensors))
            view = int(turns[step % len(self.sensors)])
            for key in self.truth:
                self.parameters[key] = self._value(optimizer, key)
            self.parameters.update()
            image = mi.render(
                self.scene, self.parameters, sensor=self.sensors[view], integrator=integrator,
                seed=seed + step, spp=spp,
            )  # fmt: skip
            target = self.photographs[view]
            loss = dr.mean(dr.square((image - target) / (target + 0.01)), axis=None)
            dr.backward(loss)
            optimizer.step()
            for key in self.truth:
                if not _is_logarithm(key):
                    low, high = (0.01, 10) if key.startswith("sky") else (0.02, 0.98)
                    optimizer[key] = dr.clip(optimizer[key], low, high)
            dr.eval(optimizer)
            dr.sync_thread()
            spent += time.process_time() - begin
            step += 1
            yield spent, lambda: self._errors(optimizer)
        for key, value in self.truth.items():
            self.parameters[key] = value
        self.parameters.update()

    def _start(self, key: str, truth):
        if _is_logarithm(key):
            return dr.log(mi.Color3f(10))
        return dr.full(mi.TensorXf, 1.0 if key.startswith("sky") else 0.4, truth.shape)

    def _value(self, optimizer: mi.ad.Adam, key: str):
        return dr.exp(optimizer[key]) if _is_logarithm(key) else optimizer[key]

    def _errors(self, optimizer: mi.ad.Adam) -> dict[str, float]:
        sums: dict[str, list[np.ndarray]] = {}
        for key, truth in self.truth.items():
            found, truth = np.array(dr.detach(optimizer[key])), np.array(truth)
            if _is_logarithm(key):
                truth = np.log(truth)
            difference = np.abs(found - truth)
            if key in self._seen:
                difference = difference[self._seen[key]]
            kind = "roughness" if "roughness" in key else "sky" if key.startswith("sky") else (
                "lamps" if _is_logarithm(key) else "albedo")
            sums.setdefault(kind, []).append(difference.ravel())
        return {kind: float(np.concatenate(each).mean()) for kind, each in sums.items()}


def _is_logarithm(key: str) -> bool:
    return key.endswith("radiance.value")


@click.command()
@click.option("--seconds", default=120.0, show_default=True, help="Of each optimization.")
@click.option("--size", default=(96, 54), type=(int, int), show_default=True)
@click.option("--spp", default=4, show_default=True, help="Samples per pixel of a step.")
@click.option("--batch", "is_batch", is_flag=True, help="All photographs in each step.")
@click.option("--rate", "rates", multiple=True, default=(0.02,), show_default=True, type=float)
@click.option("--integrator", "names", multiple=True, default=("prb", "lights"), show_default=True,
              type=click.Choice(list(INTEGRATORS)))
def main(seconds, size, spp, is_batch, rates, names) -> None:
    """Runs the optimization with each integrator and each learning rate."""
    mi.set_variant("llvm_ad_rgb")
    recovery = Recovery(size, is_batch)
    count = sum(int(np.prod(np.array(value).shape)) for value in recovery.truth.values())
    print(f"{count} parameters", flush=True)
    for rate in rates:
        for name in names:
            steps, next_print = 0, seconds / 8
            for spent, errors in recovery.run(INTEGRATORS[name], seconds, rate, spp, 0):
                steps += 1
                if spent >= next_print:
                    next_print += seconds / 8
                    listed = ", ".join(f"{kind} {x:.4f}" for kind, x in errors().items())
                    print(f"{name}, rate {rate}: {spent:.0f} s, {steps} steps: {listed}", flush=True)
            print(f"    {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB", flush=True)


if __name__ == "__main__":
    main()
