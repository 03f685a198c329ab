"""Choices among lights in scenes on which nothing was tuned: streets, cells, bulbs, and few lights.

    python benchmarks/many_lights.py [SCENE …] [--choices path,power,spatial,linear,tree] [--spp 16]
    python benchmarks/many_lights.py street --choices path,tree --picture FILE.jpg

A scene is one of these, or the name of a file in scenes/. For each choice of lights, prints relMSE
(the variance between seeds), the CPU time of a render, and the efficiency relative to the first
choice: of all pixels, and without the largest 0.1 % of the errors. The choices take turns. A
picture has a render of each choice, side by side.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import mitsuba_ext  # noqa: F401

import mitsuba as mi  # isort: skip

SIZE = 128, 72
SCENES = Path(__file__).parent.parent / "scenes"


def _color(*v: float) -> dict:
    return {"type": "rgb", "value": [float(x) for x in (v if len(v) == 3 else v * 3)]}


def _diffuse(*v: float) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _color(*v)}}


def _lamp(*v: float) -> dict:
    return {"type": "area", "radiance": _color(*v)}


def _camera(origin: list, target: list, fov: float) -> dict:
    return {
        "type": "perspective", "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "pixel_format": "rgb"},
    }  # fmt: skip


def _panel(p: list, size: tuple, turn: tuple | None = None, **more) -> dict:
    to_world = mi.ScalarTransform4f().translate([float(x) for x in p])
    if turn:
        to_world = to_world.rotate(*turn)
    return {"type": "rectangle", "to_world": to_world.scale([*map(float, size), 1.0]), **more}


def _block(low: list, high: list, **more) -> dict:
    low, high = np.array(low, float), np.array(high, float)
    to_world = mi.ScalarTransform4f().translate((low + high) / 2).scale((high - low) / 2)
    return {"type": "cube", "to_world": to_world, **more}


def _ball(p: list, radius: float, *radiance: float) -> dict:
    center = [float(x) for x in p]
    return {"type": "sphere", "center": center, "radius": radius, "emitter": _lamp(*radiance)}


def _mesh(vertices: np.ndarray, faces: np.ndarray, *radiance: float) -> dict:
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    path = Path(tempfile.mkdtemp()) / "mesh.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "emitter": _lamp(*radiance)}


def _houses(rng: np.random.Generator) -> tuple[dict, list]:
    """A street without lights, and the places of windows."""
    scene = {
        "type": "scene", "sensor": _camera([0, -30, 7], [3, 40, 2], 55),
        "ground": _panel([0, 200, 0], (60, 260), bsdf=_diffuse(0.3)),
    }  # fmt: skip
    windows = []
    for side in (-1, 1):
        for i, y in enumerate(np.arange(0, 400, 16)):
            height, x = rng.uniform(8, 25), side * rng.uniform(11, 13)
            ends = sorted([x, x + 10 * side])
            bsdf = _diffuse(*rng.uniform(0.3, 0.6, 3))
            name = f"house_{side}_{i}"
            scene[name] = _block([ends[0], y, 0], [ends[1], y + 14, height], bsdf=bsdf)
            for _ in range(19):
                p = [x - 0.03 * side, y + rng.uniform(1, 13), rng.uniform(1, height - 1)]
                windows.append((p, ([0, 1, 0], -90 * side)))
    return scene, windows


def street() -> dict:
    """50 street lamps and 950 lit windows."""
    rng = np.random.default_rng(11)
    scene, windows = _houses(rng)
    for i, y in enumerate(np.arange(0, 400, 16)):
        for x in (-6, 6):
            lamp = _panel([x, y, 6], (0.3, 0.15), ([1, 0, 0], 180), emitter=_lamp(60, 50, 35))
            scene[f"lamp_{i}_{x}"] = lamp
    colors = np.array([[9, 7, 4], [5, 6, 8], [8, 5, 2]])
    for i, (p, turn) in enumerate(windows):
        color = colors[rng.choice(3)] * np.exp(rng.normal(-0.5, 0.8))
        scene[f"window_{i}"] = _panel(p, (0.5, 0.4), turn, emitter=_lamp(*color))
    return scene


def bulbs() -> dict:
    """Ten thousand bulbs over a street, which are three meshes (mitsuba3#1883)."""
    rng = np.random.default_rng(8)
    scene, _windows = _houses(rng)
    corners = 0.05 * np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2],
                      [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])  # fmt: skip
    t = np.arange(10_000)
    x, y = -9 + 18 * (t % 100) / 99, 4.0 * (t // 100) + rng.normal(0, 0.1, len(t))
    centers = np.stack([x, y, 6 + 2 * (x / 9) ** 2], axis=1)
    for i, color in enumerate(((30, 3, 2), (3, 25, 4), (4, 6, 30))):
        mine = centers[t % 3 == i]
        vertices = (mine[:, None] + corners).reshape(-1, 3)
        index = (faces + 6 * np.arange(len(mine))[:, None, None]).reshape(-1, 3)
        scene[f"bulbs_{i}"] = _mesh(vertices, index, *color)
    return scene


def terrace() -> dict:
    """The street by day: sun, sky and 30 lamps."""
    scene, _windows = _houses(np.random.default_rng(2))
    for i in range(30):
        p = [6 * (-1) ** i, 8 * i, 5]
        lamp = _panel(p, (0.3, 0.15), ([1, 0, 0], 180), emitter=_lamp(60))
        scene[f"lamp_{i}"] = lamp
    sun = {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": _color(3)}
    return scene | {"sun": sun, "sky": {"type": "constant", "radiance": _color(0.5, 0.6, 0.8)}}


def cells() -> dict:
    """64 rooms with doorways and four lamps each."""
    rng = np.random.default_rng(4)
    scene = {
        "type": "scene", "sensor": _camera([1.5, 1.0, 2.2], [9, 9, 0.8], 75),
        "floor": _panel([16, 16, 0], (16, 16), bsdf=_diffuse(0.5)),
        "ceiling": _panel([16, 16, 2.8], (16, 16), bsdf=_diffuse(0.7)),
    }  # fmt: skip
    for i in range(9):
        for j in range(8):
            for part, (begin, end) in enumerate(((0, 1.3), (2.5, 4))):
                low, high = [4 * i - 0.05, 4 * j + begin, 0], [4 * i + 0.05, 4 * j + end, 2.8]
                bsdf = _diffuse(*rng.uniform(0.4, 0.7, 3))
                scene[f"x_{i}_{j}_{part}"] = _block(low, high, bsdf=bsdf)
                low, high = ([v[1], v[0], v[2]] for v in (low, high))
                scene[f"y_{i}_{j}_{part}"] = _block(low, high, bsdf=bsdf)
    for i in range(256):
        corner = 4 * np.array([i // 32, i // 4 % 8])
        p = [*corner + rng.uniform(0.4, 3.6, 2), rng.choice([0.4, 1.5, 2.4])]
        radiance = rng.uniform(20, 40, 3) * np.exp(rng.normal(0, 0.7))
        scene[f"lamp_{i}"] = _ball(p, rng.uniform(0.03, 0.1), *radiance)
    return scene


def cells_and_sky() -> dict:
    """The same under a sky that is seen from nowhere."""
    return cells() | {"sky": {"type": "constant", "radiance": _color(1)}}


def _room(**lights: dict) -> dict:
    return {
        "type": "scene", "sensor": _camera([0, -3.9, 1.4], [0, 0, 1.1], 65),
        "floor": _panel([0, 0, 0], (3, 4), bsdf=_diffuse(0.5)),
        "ceiling": _panel([0, 0, 3], (3, 4), bsdf=_diffuse(0.8)),
        "back": _panel([0, 4, 1.5], (3, 1.5), ([1, 0, 0], 90), bsdf=_diffuse(0.7)),
        "left": _panel([-3, 0, 1.5], (1.5, 4), ([0, 1, 0], 90), bsdf=_diffuse(0.6, 0.2, 0.2)),
        "right": _panel([3, 0, 1.5], (1.5, 4), ([0, 1, 0], 90), bsdf=_diffuse(0.2, 0.6, 0.2)),
        "tall": _block([-1.5, 0.5, 0], [-0.3, 1.7, 1.4], bsdf=_diffuse(0.6)),
        "low": _block([0.6, -0.5, 0], [1.5, 0.4, 0.7], bsdf=_diffuse(0.3, 0.3, 0.6)),
        **lights,
    }  # fmt: skip


def tube() -> dict:
    """A room with one light, a knotted tube of 10⁵ triangles."""
    n, m = 2500, 20
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    radius = 2 + np.cos(3 * t)
    p = np.stack([radius * np.cos(2 * t), radius * np.sin(2 * t), np.sin(3 * t)], 1)
    p = 0.6 * p + [0, 0.5, 1.5]
    tangent = np.roll(p, -1, 0) - np.roll(p, 1, 0)
    a = np.cross(tangent, [0, 0, 1.0])
    b = np.cross(tangent, a)
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    u = np.linspace(0, 2 * np.pi, m, endpoint=False)[:, None]
    around = a[:, None] * np.cos(u) + b[:, None] * np.sin(u)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a, b, c, d = ((i + k) % n * m + (j + q) % m for k, q in ((0, 0), (1, 0), (0, 1), (1, 1)))
    faces = np.stack([a, c, b, b, c, d], -1).reshape(-1, 3)
    return _room(light=_mesh((p[:, None] + 0.04 * around).reshape(-1, 3), faces, 2, 4, 6))


def three() -> dict:
    """A room with three lights."""
    return _room(
        ceiling_lamp=_panel([0, 0, 2.95], (0.5, 0.5), ([1, 0, 0], 180), emitter=_lamp(10)),
        globe=_ball([-2, 1.5, 1.8], 0.12, 20, 14, 8),
        window=_panel([2.95, -1, 1.5], (0.4, 0.3), ([0, 1, 0], -90), emitter=_lamp(5, 6, 9)),
    )


def three_and_sky() -> dict:
    """The same room, half open to a bright sky."""
    scene = three()
    scene["back"] = _panel([-1.5, 4, 1.5], (1.5, 1.5), ([1, 0, 0], 90), bsdf=_diffuse(0.7))
    return scene | {"sky": {"type": "constant", "radiance": _color(2, 2.5, 3)}}


def one_panel() -> dict:
    """A room with one rectangle."""
    lamp = _panel([0, 0, 2.95], (0.6, 0.6), ([1, 0, 0], 180), emitter=_lamp(12))
    return _room(lamp=lamp)


def one_globe() -> dict:
    """A room with one sphere."""
    return _room(lamp=_ball([0, 0, 2.3], 0.25, 14))


def one_cube() -> dict:
    """A room with one cube."""
    return _room(lamp=_block([-0.2, -0.2, 2.2], [0.2, 0.2, 2.5], emitter=_lamp(14)))


HOLD_OUTS = {
    f.__name__: f
    for f in (street, bulbs, terrace, cells, cells_and_sky, tube, three, three_and_sky, one_panel,
              one_globe, one_cube)
}  # fmt: skip


def _load(name: str, width: int, height: int) -> mi.Scene:
    if name not in HOLD_OUTS:
        return mi.load_file(str(SCENES / f"{name}.xml"), width=width, height=height)
    scene = HOLD_OUTS[name]()
    scene["sensor"]["film"] |= {"width": width, "height": height}
    return mi.load_dict(scene)


def _integrators(choices: list[str]) -> dict[str, mi.Integrator]:
    return {
        choice: mi.load_dict(
            {"type": choice, "max_depth": 6} if choice in ("path", "neepp", "auto_path", "auto")
            else {"type": "composed_path", "max_depth": 6, "next_event": choice}
        )
        for choice in choices
    }  # fmt: skip


def draw(name: str, choices: list[str], spp: int, file: str) -> None:
    """Writes a picture of renders with each choice, side by side."""
    scene = _load(name, 400, 225)
    images = [
        np.array(mi.render(scene, integrator=each, spp=spp, seed=1))
        for each in _integrators(choices).values()
    ]
    white = np.quantile(np.mean(images, axis=0), 0.95)
    bitmap = mi.Bitmap(np.concatenate(images, axis=1).astype(np.float32) * (0.8 / white))
    bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(file, quality=80)


def measure(name: str, choices: list[str], spp: int, rounds: int) -> None:
    """Renders a scene with each choice, and prints a row for each."""
    scene, integrators = _load(name, *SIZE), _integrators(choices)
    images, times = ({choice: [] for choice in choices} for _ in range(2))
    for round_ in range(-1, rounds):
        for place, choice in enumerate(choices if round_ % 2 else choices[::-1]):
            begin = time.process_time()
            seed = 7919 * (len(choices) * round_ + place + 10)
            image = np.array(mi.render(scene, integrator=integrators[choice], spp=spp, seed=seed))
            if round_ >= 0:  # The first round compiles
                times[choice].append(time.process_time() - begin)
                images[choice].append(image)
    reference = np.mean([np.mean(x, axis=0) for x in images.values()], axis=0)
    floor = 1e-2 * reference.mean() ** 2
    print(f"{name}: {len(scene.emitters())} emitters", flush=True)
    first = None
    for choice in choices:
        variance = np.var(images[choice], axis=0, ddof=1) / (reference**2 + floor)
        error = np.sort(variance.mean(axis=-1).ravel())
        errors = np.array([error.mean(), error[: round(0.999 * len(error))].mean()])
        seconds = np.median(times[choice])
        first = errors * seconds if first is None else first
        efficiency, trimmed = first / (errors * seconds)
        print(
            f"  {choice:10s} relMSE {errors[0]:.4f}  {seconds:.3f} s  efficiency {efficiency:.2f}  "
            f"trimmed {trimmed:.2f}", flush=True,
        )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", default=[*HOLD_OUTS])
    parser.add_argument("--choices", default="path,power,spatial,linear,tree")
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--picture", metavar="FILE")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for name in arguments.scenes:
        if arguments.picture:
            draw(name, arguments.choices.split(","), arguments.spp, arguments.picture)
            continue
        measure(name, arguments.choices.split(","), arguments.spp, arguments.rounds)


if __name__ == "__main__":
    main()
