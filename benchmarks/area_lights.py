"""Compares ``solid_angle_area`` with ``area``: variance of direct light at equal samples, and time.

    .venv/bin/python benchmarks/area_lights.py

Each scene is a diffuse floor under one light that the camera does not see, with posts that cast
shadows (``--posts 0`` leaves them out). Writes one row of Markdown for each: the variance of
``area`` over that of ``solid_angle_area`` (between seeds, the mean over pixels), the CPU time of
``solid_angle_area`` over that of ``area`` (the least of renders that take turns), and the
efficiency that follows from both.
"""

from __future__ import annotations

from typing import Any

import click
from equal_samples import print_header, print_row, render_in_turns

import mitsuba_ext  # noqa: F401  (before mitsuba: it chooses the LLVM library)

import mitsuba as mi  # isort: skip

#: Shape, half edges (or radius), and height of the centre above the floor.
LIGHTS: dict[str, tuple[str, list[float], float]] = {
    "panel, close": ("rectangle", [1, 0.6, 1], 0.15),
    "panel, at its width": ("rectangle", [1, 0.6, 1], 2),
    "strip along a wall": ("wall", [1.5, 0.04, 1], 0.1),
    "disk, close": ("disk", [1, 1, 1], 0.2),
    "flat box, close": ("cube", [1, 0.6, 0.05], 0.25),
    "sphere, nearly touching": ("sphere", [1, 1, 1], 1.01),
    "panel, distant": ("rectangle", [1, 0.6, 1], 20),
    "disk, distant": ("disk", [1, 1, 1], 20),
    "box, distant": ("cube", [0.5, 0.5, 0.5], 20),
    "sphere, distant": ("sphere", [1, 1, 1], 20),
}


@click.command()
@click.argument("names", nargs=-1)
@click.option("--integrator", default="path")
@click.option("--emitter", default="solid_angle_area", help="Compared with area.")
@click.option("--sampling", default="", help="The parameter of the emitter.")
@click.option("--sampler", default="independent")
@click.option("--spp", default=16)
@click.option("--seeds", default=12)
@click.option("--posts", default=5, help="In each of two directions.")
@click.option("--size", default=128, help="Edge of the film, in pixels.")
def main(
    names: tuple[str, ...], integrator: str, emitter: str, sampling: str, sampler: str, spp: int,
    seeds: int, posts: int, size: int,
) -> None:  # fmt: skip
    """Compares the scenes whose names begin with one of NAMES (all, if there is none)."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    method = mi.load_dict({"type": integrator, "max_depth": 2, "hide_emitters": True})
    print_header(["light", "variance", "time", "efficiency"])
    for name, light in LIGHTS.items():
        if names and not name.startswith(names):
            continue
        kinds: list[dict[str, Any]] = [{"type": "area"}, {"type": emitter}]
        if sampling:
            kinds[1]["sampling"] = sampling
        scenes = {kind["type"]: _scene(kind, *light, sampler, posts, size) for kind in kinds}
        jobs = {kind: (scene, method, spp) for kind, scene in scenes.items()}
        area, other = render_in_turns(jobs, seeds).values()
        gain = area.variance.mean() / other.variance.mean()
        slower = min(other.seconds) / min(area.seconds)
        print_row([name, f"{gain:.2f}", f"{slower:.2f}", f"{gain / slower:.2f}"])


def _scene(
    emitter: dict[str, Any], shape: str, scale: list[float], height: float, sampler: str,
    posts: int, size: int,
) -> mi.Scene:  # fmt: skip
    T = mi.ScalarTransform4f
    # A strip stands upright and shines along the floor, of which the camera sees the part before it
    is_upright = shape == "wall"
    turn = T().rotate([1, 0, 0], 90 if is_upright else 180)
    lamp = {
        "type": "rectangle" if is_upright else shape,
        "to_world": T().translate([0, 1 if is_upright else 0, height]) @ turn.scale(scale),
        "emitter": {**emitter, "radiance": {"type": "rgb", "value": 1.0}},
    }
    camera = {
        "type": "orthographic",
        "to_world": T().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0]).scale([1.5, 1, 1]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        "sampler": {"type": sampler},
    }
    floor = {"type": "rectangle", "to_world": T().scale([5, 5, 1])}
    # Flat enough to stand below the lights
    top = 0.008 if shape == "sphere" else 0.06
    things = {
        f"post{i}": {
            "type": "cube",
            "to_world": T().translate([0.4 * (i % posts - posts // 2),
                                       0.4 * (i // posts - posts // 2), top / 2])
            .scale([0.04, 0.04, top / 2]),
        }
        for i in range(posts * posts)
    }  # fmt: skip
    scene = {"type": "scene", "camera": camera, "floor": floor, "lamp": lamp, **things}
    return mi.load_dict(scene, optimize=False)


if __name__ == "__main__":
    main()
