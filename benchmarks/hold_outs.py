"""Writes scenes that no choice of ``auto`` was tuned on, as XML files:
``benchmarks/hold_outs.py FOLDER``, and then ``benchmarks/choices.py FOLDER/*.xml``.

Each one is simple, and has something that the scenes of this repository do not have: a mesh of ten
thousand triangles that emits light, hair, masks, a projector, a lamp behind frosted glass. Results:
[auto](../docs/results/auto.md#hold-outs).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

Node = dict[str, Any]

#: What makes each scene, from the folder for its files.
SCENES: dict[str, Callable[[Path], Node]] = {}


def scene(make: Callable[[Path], Node]) -> Callable[[Path], Node]:
    SCENES[make.__name__] = make
    return make


def at(*place: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate(list(place))


def rgb(*value: float) -> Node:
    return {"type": "rgb", "value": list(value if len(value) > 1 else value * 3)}


def diffuse(*value: float) -> Node:
    return {"type": "twosided", "inside": {"type": "diffuse", "reflectance": rgb(*value)}}


def emits(*radiance: float) -> Node:
    black = {"type": "diffuse", "reflectance": rgb(0.0)}
    return {"bsdf": black, "emitter": {"type": "area", "radiance": rgb(*radiance)}}


def rectangle(to_world: mi.ScalarTransform4f, bsdf: Node | None = None) -> Node:
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or diffuse(0.6)}


def panel(x: float, y: float, z: float, size: float, radiance: float, turn: float = 180) -> Node:
    place = at(x, y, z).rotate([1, 0, 0], turn).scale(size)
    return {"type": "rectangle", "to_world": place, **emits(radiance)}


def ball(x: float, y: float, radius: float, bsdf: Node, z: float | None = None) -> Node:
    z = radius if z is None else z
    return {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": bsdf}


def bulb(x: float, y: float, z: float, radius: float, *radiance: float) -> Node:
    return {"type": "sphere", "center": [x, y, z], "radius": radius, **emits(*radiance)}


def block(x: float, y: float, z: float, size: list[float], bsdf: Node, turn: float = 0) -> Node:
    place = at(x, y, z).rotate([0, 0, 1], turn).scale(size)
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


def aimed(origin: list[float], target: list[float], up: tuple = (0, 0, 1)) -> Any:
    return mi.ScalarTransform4f().look_at(origin=origin, target=target, up=list(up))


def camera(origin=(0, -4.5, 1.5), target=(0, 0, 1), fov: float = 50, **changes: Any) -> Node:
    """A sensor. The film is that of ``choices.py``."""
    return {
        "type": "perspective", "fov": fov, "to_world": aimed(list(origin), list(target)),
        "film": {"type": "hdrfilm", "width": 320, "height": 180}, **changes,
    }  # fmt: skip


def hall(things: Node, height: float = 3.0, wall: Node | None = None, **changes: Any) -> Node:
    """A closed room, six units wide and ten long, of the camera at its end."""
    wall = wall or diffuse(0.7, 0.7, 0.65)
    walls = {
        "floor": rectangle(at(0, 0, 0).scale([3, 5, 1]), diffuse(0.5, 0.4, 0.3)),
        "ceiling": rectangle(at(0, 0, height).scale([3, 5, 1]), wall),
        "back": rectangle(at(0, 5, 0).rotate([1, 0, 0], 90).scale([3, height, 1]), wall),
        "front": rectangle(at(0, -5, 0).rotate([1, 0, 0], 90).scale([3, height, 1]), wall),
        "left": rectangle(at(-3, 0, 0).rotate([0, 1, 0], 90).scale([height, 5, 1]), wall),
        "right": rectangle(at(3, 0, 0).rotate([0, 1, 0], 90).scale([height, 5, 1]), wall),
    }
    return {"type": "scene", "camera": camera(), **{**walls, **things}, **changes}


def ground(things: Node, bsdf: Node | None = None, **changes: Any) -> Node:
    """Things on a plane."""
    floor = rectangle(at(0, 0, 0).scale(12), bsdf or diffuse(0.4))
    return {"type": "scene", "camera": camera(), "floor": floor, **things, **changes}


def image(folder: Path, name: str, pixels: np.ndarray) -> str:
    mi.Bitmap(pixels.astype(np.float32)).write(str(folder / f"{name}.exr"))
    return f"{name}.exr"


def noise(folder: Path, name: str, low: float, high: float, channels: int = 3) -> Node:
    pixels = np.random.default_rng(1).uniform(low, high, (32, 32, channels))
    return {"type": "bitmap", "filename": image(folder, name, pixels), "raw": True}


def sky(folder: Path, sun: float = 0.0) -> Node:
    """An environment: brighter above, with a sun of one pixel."""
    rows = np.linspace(1, 0.2, 64)[:, None, None]
    pixels = rows * np.ones((1, 128, 1)) * np.array([0.6, 0.8, 1.0])
    pixels[16, 40] += sun
    name = image(folder, f"sky_{sun:g}", pixels)
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "filename": name, "to_world": turned}


FURNITURE = {
    "table": ((0.3, 0.8, 0.4), [0.8, 0.5, 0.4], 20), "box": ((-1.2, 0.5, 0.5), [0.4, 0.4, 0.5], 40)
}  # fmt: skip


def furniture(bsdf: Node | None = None) -> Node:
    bsdf = bsdf or diffuse(0.3, 0.5, 0.6)
    return {name: block(*p, size, bsdf, turn) for name, (p, size, turn) in FURNITURE.items()}


@scene
def blinds(folder: Path) -> Node:
    """Sun through slats."""
    slats = {
        f"slat_{i}": block(3, 0, 0.1 + 0.2 * i, [0.1, 2, 0.01], diffuse(0.8)) for i in range(14)
    }
    sun = {"type": "directional", "direction": [-1, 0.3, -0.8], "irradiance": rgb(12)}
    open_side = {"right": {"type": "constant", "radiance": rgb(0.5)}}
    return hall({**open_side, "sun": sun, **slats, **furniture()})


@scene
def bulbs_in_rows(folder: Path) -> Node:
    """Three hundred lamps, of which the camera sees half."""
    lamps = {
        f"lamp_{i}": bulb(0.28 * x - 2.7, 0.6 * y - 4.5, 2.9, 0.02, 20 + 10 * (i % 3))
        for i, (y, x) in enumerate(np.ndindex(15, 20))
    }
    return hall({**lamps, **furniture()})


@scene
def mesh_lamp(folder: Path) -> Node:
    """A lamp of ten thousand triangles."""
    n = 72
    u, v = np.meshgrid(np.arange(n) / n * 2 * np.pi, np.arange(n) / (n - 1) * np.pi)
    r = 0.4 * (1 + 0.3 * np.sin(9 * u) * np.sin(7 * v))
    p = np.stack([r * np.cos(u) * np.sin(v), r * np.sin(u) * np.sin(v), r * np.cos(v)], -1)
    i, j = np.meshgrid(np.arange(n), np.arange(n - 1))
    a, b = j * n + i, j * n + (i + 1) % n
    faces = np.concatenate([np.stack([a, a + n, b], -1), np.stack([b, a + n, b + n], -1)])
    mesh = mi.Mesh("lamp", n * n, faces.size // 3)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (p + [0, 1, 2.2]).astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    mesh.write_ply(str(folder / "lamp.ply"))
    lamp = {"type": "ply", "filename": "lamp.ply", "face_normals": True, **emits(4)}
    return hall({"lamp": lamp, **furniture()})


@scene
def small_window(folder: Path) -> Node:
    """Sun and sky through a window of a hundredth of the walls."""
    wall = diffuse(0.7)
    around = [
        (-2.3, 1.5, 2.7, 1.5),
        (3.2, 1.5, 1.8, 1.5),
        (0.9, 0.5, 0.5, 0.5),
        (0.9, 2.5, 0.5, 0.5),
    ]
    side = {
        f"right_{i}": block(3, y, z, [0.05, width, height], wall)
        for i, (y, z, width, height) in enumerate(around)
    }
    principled = {"type": "principled", "base_color": rgb(0.6, 0.3, 0.1), "roughness": 0.3}
    sun = {"type": "sunsky", "sun_direction": [0.8, -0.2, 0.5]}
    return hall({"right": sun, **side, **furniture(principled)})


@scene
def glass_in_the_sun(folder: Path) -> Node:
    balls = {f"ball_{i}": ball(i - 2, 0.4 * (i % 2), 0.4, {"type": "dielectric"}) for i in range(5)}
    return ground({**balls, "sky": sky(folder, 2e4)})


@scene
def tufts(folder: Path) -> Node:
    """Hair under a sky."""
    numbers, lines = np.random.default_rng(2), []
    for _ in range(1500):
        x, y, bend = *numbers.uniform(-1.5, 1.5, 2), numbers.normal(0, 0.05, 2)
        for k in range(5):
            lines.append(f"{x + k * k * bend[0]:.4f} {y + k * k * bend[1]:.4f} {0.3 * k:.3f} 0.015")
        lines.append("")
    (folder / "hair.txt").write_text("\n".join(lines))
    hair = {"type": "bsplinecurve", "filename": "hair.txt", "bsdf": {"type": "hair"}}
    return ground({"hair": hair, "sky": sky(folder, 500)})


@scene
def foliage(folder: Path) -> Node:
    """Layers of masks, which let light through at random."""
    leaf = {"type": "twosided", "inside": {"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.1)}}
    pixels = np.random.default_rng(1).uniform(0, 1, (32, 32, 1)) > 0.6
    holes = {"type": "bitmap", "filename": image(folder, "leaves", pixels), "raw": True,
             "filter_type": "nearest"}  # fmt: skip
    mask = {"type": "mask", "opacity": holes, "inside": leaf}
    layers = {
        f"leaf_{i}": rectangle(at(0, 0.5, 1.2 + 0.3 * i).rotate([0, 0, 1], 23 * i).scale(1.8), mask)
        for i in range(5)
    }
    sun = {"type": "directional", "direction": [0.2, 0.3, -1], "irradiance": rgb(4)}
    return ground({**layers, "sun": sun, "sky": sky(folder), **furniture()})


@scene
def bumps(folder: Path) -> Node:
    """Bumps, normal maps, blends, a clear coat."""
    height = noise(folder, "bumps", 0, 1, 1)
    bsdfs = [
        {"type": "bumpmap", "arbitrary": height, "scale": 0.1, "in": {"type": "roughplastic"}},
        {"type": "normalmap", "normalmap": noise(folder, "normals", 0.35, 0.95),
         "in": {"type": "roughconductor", "alpha": 0.2}},
        {"type": "blendbsdf", "weight": height, "a": {"type": "roughconductor", "alpha": 0.05},
         "b": {"type": "diffuse"}},
        {"type": "principled", "base_color": rgb(0.7, 0.1, 0.1), "clearcoat": 1.0,
         "metallic": 0.5, "anisotropic": 0.7, "roughness": 0.3},
        {"type": "pplastic", "alpha": 0.05},
    ]  # fmt: skip
    things = {f"ball_{i}": ball(i - 2, 0.3, 0.45, bsdf) for i, bsdf in enumerate(bsdfs)}
    return ground({**things, "sky": sky(folder, 3000), "lamp": panel(0, -1, 3, 0.4, 6)})


@scene
def slit(folder: Path) -> Node:
    """All light comes through a slit from the next room."""
    wall = diffuse(0.7)
    parts = {
        "wall_1": block(-1.55, 2, 1.5, [1.45, 0.05, 1.5], wall),
        "wall_2": block(1.55, 2, 1.5, [1.45, 0.05, 1.5], wall),
    }
    return hall({**parts, "lamp": panel(-2, 3.5, 2.9, 0.4, 150), **furniture()})


@scene
def frosted(folder: Path) -> Node:
    """A small lamp in a shade of frosted glass."""
    shade = ball(0.5, 1, 0.35, {"type": "roughdielectric", "alpha": 0.3}, z=2)
    return hall({"shade": shade, "lamp": bulb(0.5, 1, 2, 0.08, 150), **furniture()})


@scene
def television(folder: Path) -> Node:
    pixels = np.random.default_rng(4).exponential(1, (9, 16, 3)) ** 2
    shown = {"type": "bitmap", "filename": image(folder, "shown", pixels), "raw": True}
    screen = {
        "type": "rectangle",
        "to_world": at(-2.9, 1, 1.2).rotate([0, 1, 0], 90).scale([0.5, 0.9, 1]),
        "bsdf": diffuse(0.0), "emitter": {"type": "area", "radiance": shown},
    }  # fmt: skip
    return hall({"screen": screen, **furniture({"type": "plastic"})})


@scene
def town(folder: Path) -> Node:
    """Seen from above, without perspective, in meters."""
    numbers = np.random.default_rng(5)
    houses = {
        f"house_{i}": block(
            40 * (i % 12) - 220, 40 * (i // 12) - 220, z, [14, 12, z],
            diffuse(*numbers.uniform(0.2, 0.8, 3)),
        )
        for i, z in enumerate(numbers.uniform(5, 60, 144))
    }  # fmt: skip
    seen = {
        "type": "orthographic", "film": camera()["film"], "far_clip": 2000,
        "to_world": aimed([0, -300, 400], [0, 0, 0]).scale([200, 200, 1]),
    }  # fmt: skip
    floor = rectangle(at(0, 0, 0).scale(400), diffuse(0.3))
    sun = {"type": "sunsky", "sun_direction": [0.5, -0.4, 0.6]}
    return ground({**houses, "sun": sun}, camera=seen, floor=floor)


@scene
def bokeh(folder: Path) -> Node:
    """Lamps out of focus."""
    numbers = np.random.default_rng(6)
    lamps = {
        f"lamp_{i}": bulb(*numbers.uniform([-3, 2, 0.2], [3, 4.5, 2.5]), 0.015, 400)
        for i in range(40)
    }
    lens = camera(type="thinlens", aperture_radius=0.08, focus_distance=4.5)
    return hall({**lamps, **furniture()}, camera=lens)


@scene
def forest(folder: Path) -> Node:
    """Three hundred instances."""
    tree = {
        "type": "shapegroup", "trunk": block(0, 0, 0.3, [0.03, 0.03, 0.3], diffuse(0.3, 0.2, 0.1)),
        "crown": ball(0, 0, 0.2, {"type": "twosided", "in": {"type": "principled",
                      "base_color": rgb(0.1, 0.4, 0.1), "roughness": 0.5}}, z=0.7),
    }  # fmt: skip
    numbers = np.random.default_rng(7)
    trees = {
        f"tree_{i}": {
            "type": "instance", "group": {"type": "ref", "id": "tree"},
            "to_world": at(*numbers.uniform(-3, 4, 2), 0).scale(numbers.uniform(0.6, 1.4)),
        }
        for i in range(300)
    }  # fmt: skip
    sun = {"type": "sunsky", "sun_direction": [1, 0.5, 0.4]}
    return ground({"tree": tree, **trees, "sun": sun})


@scene
def cove(folder: Path) -> Node:
    """Lamps that shine up, near the ceiling: all other light is indirect."""
    lamps = {f"lamp_{i}": panel(2.5 * (2 * i - 1), 1, 2.6, 0.3, 40, 0) for i in range(2)}
    shelves = {
        f"shelf_{i}": block(2.5 * (2 * i - 1), 1, 2.55, [0.45, 0.5, 0.02], diffuse(0.6))
        for i in range(2)
    }
    return hall({**lamps, **shelves, **furniture()})


@scene
def white_hall(folder: Path) -> Node:
    return hall({"lamp": panel(0, 1, 2.99, 0.8, 2), **furniture(diffuse(0.9))}, wall=diffuse(0.9))


@scene
def street_lamps(folder: Path) -> Node:
    """A hundred points of light."""
    lamps = {
        f"lamp_{i}": {"type": "point", "position": [1.2 * (i % 10) - 5, 1.2 * (i // 10) - 4, 0.6],
                      "intensity": rgb(0.3, 0.2 + 0.02 * (i % 5), 0.1)}
        for i in range(100)
    }  # fmt: skip
    return ground({**lamps, **furniture()})


@scene
def in_a_ball(folder: Path) -> Node:
    """The camera is in a ball of glass."""
    around = ball(0, -4.5, 0.4, {"type": "dielectric"}, z=1.5)
    return hall({"around": around, "lamp": panel(0, 1, 2.9, 0.5, 8), **furniture()})


@scene
def bottles(folder: Path) -> Node:
    """Glass, rough and smooth, thin and coloured, between the lamp and all else."""
    kinds = [
        {"type": "dielectric"}, {"type": "roughdielectric", "alpha": 0.05},
        {"type": "principled", "base_color": rgb(0.4, 0.8, 0.5), "spec_trans": 0.95,
         "roughness": 0.1},
        {"type": "thindielectric"},
        {"type": "principledthin", "base_color": rgb(0.8, 0.4, 0.2), "spec_trans": 0.6,
         "diff_trans": 0.6, "roughness": 0.3},
    ]  # fmt: skip
    things = {f"ball_{i}": ball(i - 2, 1, 0.45, kind) for i, kind in enumerate(kinds)}
    return hall({**things, "lamp": bulb(0, 2.8, 1.5, 0.15, 60)})


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
def main(folder: Path) -> None:
    """Writes them into FOLDER."""
    mi.set_variant("llvm_ad_rgb")
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in SCENES.items():
        parsed = mi.parser.parse_dict(mi.parser.ParserConfig("llvm_ad_rgb"), make(folder))
        mi.parser.write_file(parsed, str(folder / f"{name}.xml"))


if __name__ == "__main__":
    main()
