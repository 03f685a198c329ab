"""Compares ``lens_sampling`` of ``light_tracer`` by visibility with uniform sampling, where things
near the lens, out of focus, hide a part of it:

    .venv/bin/python benchmarks/lens_sampling.py edge bars night_classroom

Writes one row of Markdown for each scene and region: all pixels; and those in which 10 to 50 %, and
50 to 90 %, of the camera rays meet something nearer than half the focus distance. ``unblocked`` is
the share of the shadow rays to the lens that find nothing in between, for splats in the region. The
gain is the ratio of the errors of ``benchmarks/equal_samples.py``, that of uniform sampling first;
time is CPU time relative to uniform sampling, with the depth maps and the table. The efficiency is
gain / time.
"""

from __future__ import annotations

import click
import numpy as np
from equal_samples import (
    camera_rays,
    error,
    load,
    options,
    print_header,
    print_row,
    render_in_turns,
    title,
)

from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.lens import LENS_SAMPLING, connectable_sensor
from mitsuba_ext.estimators.light_paths.light_walk import LightWalk
from mitsuba_ext.estimators.light_paths.sensor import is_occluded
from mitsuba_ext.transport.numbers import hashed_2d
from mitsuba_ext.transport.path_decisions import SceneQuery

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

COLUMNS = ["scene", "pixels", "share", "unblocked: uniform", "visibility"]
COLUMNS += ["gain", "time", "efficiency"]

#: Regions: how many of a pixel's camera rays meet something near.
REGIONS = {"all": (0.0, 1.01), "10 to 50 %": (0.1, 0.5), "50 to 90 %": (0.5, 0.9)}


def room(near: list[tuple[float, float]], size: tuple[int, int]) -> mi.Scene:
    """A ball in a room, in focus. Panels before the lens, 2 high and of these x and widths, hide a
    part of it."""
    to = mi.ScalarTransform4f
    white = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    view = to().look_at(origin=[0, -4, 1], target=[0, 0, 1], up=[0, 0, 1])
    width, height = size
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb",
            "rfilter": {"type": "box"}}  # fmt: skip
    lamp = {"type": "area", "radiance": 8.0}
    scene = {
        "type": "scene",
        "sensor": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.1, "focus_distance": 4.5,
                   "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": to().scale([3, 5, 1]), "bsdf": white},
        "wall": {"type": "rectangle", "bsdf": white,
                 "to_world": to().translate([0, 1.5, 1]).rotate([1, 0, 0], 90).scale([3, 2, 1])},
        "ball": {"type": "sphere", "center": [0.4, 0, 0.6], "radius": 0.6, "bsdf": white},
        "lamp": {"type": "rectangle", "emitter": lamp,
                 "to_world": to().translate([-0.5, 0, 2.8]).rotate([1, 0, 0], 180).scale(0.3)},
    }  # fmt: skip
    for i, (x, size) in enumerate(near):
        place = to().translate([x, -3, 1]).rotate([1, 0, 0], 90).scale([size / 2, 1, 1])
        dark = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.1}}
        scene[f"panel_{i}"] = {"type": "rectangle", "to_world": place, "bsdf": dark}
    return mi.load_dict(scene)


#: Scenes of this file.
ROOMS = {
    "edge": [(0.3, 0.5)],
    "bars": [(x, 0.1) for x in (-0.36, -0.12, 0.12, 0.36)],
    "nothing near": [],
}


def hidden(scene: mi.Scene) -> np.ndarray:
    """The share of each pixel's camera rays that meet something near: [height, width]."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    near = scene.ray_intersect(camera_rays(scene, 64)).t < 0.5 * sensor.focus_distance()
    return np.array(near).reshape(height, width, 64).mean(axis=2)


def unblocked(scene: mi.Scene, share: np.ndarray, max_depth: int) -> dict[str, list[float]]:
    """By region, the shares of unblocked shadow rays for each way to sample the lens."""
    sensor, query = scene.sensors()[0], SceneQuery()
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(1, 1 << 19)
    walk = LightWalk(LightEmission(scene), max_depth, 5, query=query)
    active = dr.full(mi.Bool, True, 1 << 19)
    vertices, _ = walk.run(scene, numbers, mi.Float(0), mi.Ray3f().wavelengths, active)
    index = dr.arange(mi.UInt32, vertices.count)
    si = vertices.at(index, mi.Bool(True)).si
    u = hashed_2d(index, mi.UInt32(0))
    found: dict[str, list[float]] = {region: [] for region in REGIONS}
    for kind in LENS_SAMPLING:
        target = connectable_sensor("light_tracer", kind, scene, sensor, query)
        connection, _ = target.connect(si, u, mi.Bool(True))
        tested = connection.active
        free = tested & ~is_occluded(query, scene, si, connection, tested)
        x, y = (np.array(v).astype(int) for v in connection.position)
        inside = np.array(tested)
        pixel = share[np.where(inside, y, 0), np.where(inside, x, 0)]
        for region, (low, high) in REGIONS.items():
            chosen = inside & (pixel >= low) & (pixel < high)
            found[region].append(np.array(free)[chosen].mean() if chosen.any() else np.nan)
    return found


@click.command()
@options
def main(names: tuple[str, ...], max_depth: int, spp: int, seeds: int, size: tuple) -> None:
    """Compares on the scenes NAMES: files, ours by their names, or edge, bars, nothing near."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    print_header(COLUMNS)
    for name in names:
        scene = room(ROOMS[name], size) if name in ROOMS else load(name, size)
        share = hidden(scene)
        reached = unblocked(scene, share, max_depth)
        tracer = {"type": "light_tracer", "max_depth": max_depth}
        jobs = {kind: (scene, {**tracer, "lens_sampling": kind}, spp) for kind in LENS_SAMPLING}
        renders = render_in_turns(jobs, seeds)
        uniform, other = (renders[kind] for kind in LENS_SAMPLING)
        mean, slower = (uniform.mean + other.mean) / 2, other.time / uniform.time
        for region, (low, high) in REGIONS.items():
            pixels = (share >= low) & (share < high)
            if pixels.sum() < 20:
                continue
            gain = error(uniform.variance, mean, pixels) / error(other.variance, mean, pixels)
            print_row([
                title(name), region, f"{pixels.mean():.3f}", *(f"{r:.3f}" for r in reached[region]),
                f"{gain:.2f}", f"{slower:.2f}", f"{gain / slower:.2f}",
            ])  # fmt: skip


if __name__ == "__main__":
    main()
