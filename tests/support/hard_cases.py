"""Scenes on which renderers fail: tiny, huge, empty, degenerate ones, and others.

Most are variations of one small stage (a floor, a wall, a block that casts a shadow, a lamp), so
that cases of the same structure share compiled kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.hidden_lights import (
    bulb_under_a_shade,
    floor_under_water,
    light_through_a_hole,
    mirror_ring,
)
from tests.support.stage import (
    Scene,
    area,
    bitmap,
    diffuse,
    film,
    lookat,
    mesh,
    octahedron,
    rectangle,
    rgb,
    sensor,
    stage,
    translated,
)


@dataclass(frozen=True)
class HardCase:
    """A scene, and how to compare integrators on it.

    Attributes:
        make: Makes the scene's dictionary in the active variant.
        precision: Relative standard error of the mean that the comparison must reach.
        spp: Samples per pixel of one render.
        parameters: Parameters of the integrators.
        is_black: The image must be zero everywhere.
        seeds: Number of renders of the integrator: two are enough if the pixels are independent.
        unit: Edge of the squares of pixels whose errors are independent of each other.
        reference: The integrator of Mitsuba that has the right mean.
        truth: Makes a scene of the same image, of which that integrator renders it rightly; by
            default, the scene itself.
    """

    make: Callable[[], Scene]
    precision: float = 0.02
    spp: int = 512
    max_depth: int = 4
    parameters: dict[str, Any] = field(default_factory=dict)
    is_black: bool = False
    seeds: int = 2
    unit: int = 1
    reference: str = "path"
    truth: Callable[[], Scene] | None = None


def _many_lights() -> Scene:
    """Spheres, because Dr.Jit compiles the methods of each rectangle separately."""
    lights = {
        f"light_{i}": {
            "type": "sphere",
            "center": [0.06 * (i % 32) - 0.9, 0.06 * (i // 32) - 0.9, 1.9],
            "radius": 0.01,
            "bsdf": {"type": "ref", "id": "black"},
            "emitter": area(5.0 + i % 7),
        }
        for i in range(1000)
    }
    return stage(light={}, black=diffuse(0.0), **lights)


def _hidden_light() -> Scene:
    box = {"type": "cube", "to_world": translated(0, 0, 9).scale(0.6), "bsdf": diffuse(0.0)}
    lamp = {"type": "sphere", "center": [0, 0, 9], "radius": 0.2, "emitter": area(5.0)}
    return stage(light=lamp, box=box)


def _delta_lights() -> Scene:
    down = lookat([-1, -1, 3], [0, 0, 0], [0, 0, 1])
    texture = {"type": "bitmap", "bitmap": bitmap(np.full((2, 2, 3), 0.8)), "raw": True}
    return stage(
        light={},
        point={"type": "point", "position": [0.8, -1, 1.5], "intensity": rgb(1.0)},
        spot={"type": "spot", "to_world": down, "intensity": rgb(3.0)},
        sun={"type": "directional", "direction": [0.2, 0.4, -1], "irradiance": rgb(0.5)},
        projector={"type": "projector", "to_world": down, "irradiance": texture, "scale": 0.3},
    )


def _sun_sky() -> Scene:
    """One texel of 1e5 above the horizon, seen past a small block."""
    pixels = np.full((16, 32, 3), 0.2)
    pixels[4, 20] = 1e5
    sky = {"type": "envmap", "bitmap": bitmap(pixels)}
    return stage(light={**sky, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}, wall=None)


def _sky_through_portals() -> Scene:
    """The same sky, of which two portals that overlap show a part; one lies in the block."""
    T = mi.ScalarTransform4f
    places = {
        "above": T().translate([0.2, 0, 1.5]).rotate([1, 0, 0], 180).scale([1, 0.7, 1]),
        "higher": T().translate([-0.3, 0, 1.8]).rotate([1, 0, 0], 180).scale(2),
        "inside": T().translate([0.4, -0.2, 0.2]).scale(0.1),
    }
    portals = {name: {"type": "portal", "to_world": place} for name, place in places.items()}
    return {**_sun_sky(), **portals}


def _textured_two_sided_lights() -> Scene:
    T = mi.ScalarTransform4f
    pixels = np.random.default_rng(1).uniform(0, 9, (4, 4, 3))
    radiance = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    back = {"type": "twosided", "bsdf": diffuse()}
    upright = [T().translate([-0.6, 0, 1]).rotate([1, 0, 0.2], 90).scale([0.5, 0.4, 1])]
    return stage(
        light={},
        front=rectangle(*upright, bsdf=back, emitter={"type": "area", "radiance": radiance}),
        back=rectangle(
            *upright, T().translate([0, 0, -1e-3]).rotate([0, 1, 0], 180), bsdf=back,
            emitter={"type": "area", "radiance": radiance},
        ),
    )  # fmt: skip


def _materials() -> Scene:
    heights = np.random.default_rng(2).uniform(0, 0.1, (8, 8, 1))
    bumps = {"type": "bitmap", "bitmap": bitmap(heights), "raw": True}
    normals = np.full((2, 2, 3), [0.6, 0.4, 0.9])
    bsdfs = {
        "mirror": {"type": "conductor"},
        "glass": {"type": "dielectric"},
        "frosted": {"type": "roughdielectric", "alpha": 1e-3},
        "pane": {"type": "thindielectric"},
        "mask": {"type": "mask", "opacity": 0.4, "bsdf": diffuse()},
        "normals": {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "bitmap": bitmap(normals), "raw": True},
            "bsdf": {"type": "roughconductor", "alpha": 0.3},
        },
        "bumps": {"type": "bumpmap", "arbitrary": bumps, "bsdf": {"type": "roughplastic"}},
        "twosided": {"type": "twosided", "bsdf": {"type": "plastic"}},
    }
    things = {}
    for i, (name, bsdf) in enumerate(bsdfs.items()):
        place = translated(0.5 * (i % 4) - 0.75, 0, 0.35 + 0.6 * (i // 4)).scale(0.2)
        things[name] = {"type": "sphere", "to_world": place, "bsdf": bsdf}
    # Seen from behind, where Mitsuba's samples of rough metal are not finite
    metal = {"type": "roughconductor", "alpha": 0.3}
    rust = {"type": "blendbsdf", "weight": 0.7, "metal": metal, "rust": diffuse()}
    place = translated(0, -0.4, 0.7).rotate([1, 0, 0], -60).scale([0.2, 0.3, 1])
    things["rust"] = {"type": "disk", "to_world": place, "bsdf": rust}
    return stage(block=None, **things)


def _closed_box() -> Scene:
    """The camera and the lamp are inside; nothing leaves."""
    room = {"type": "cube", "to_world": translated(0, 0, 1).scale(5), "flip_normals": True}
    return stage(room={**room, "bsdf": diffuse(0.4)}, wall=None)


def _instances() -> Scene:
    group = {
        "type": "shapegroup",
        "ball": {"type": "sphere", "radius": 0.25, "bsdf": diffuse()},
        "gem": octahedron(0.2, (0, 0, 0.4), bsdf=diffuse(0.2)),
    }
    places = {
        f"instance_{i}": {
            "type": "instance",
            "to_world": translated(i - 1.5, 0, 0.4),
            "group": {"type": "ref", "id": "group"},
        }
        for i in range(4)
    }
    return stage(block=None, group=group, **places)


def _degenerate_triangles() -> Scene:
    vertices = [[-1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0.5], [0, 0, 0.5], [-1, 0.5, 0.2]]
    faces = [[0, 1, 2], [3, 4, 3], [0, 0, 0], [0, 1, 1], [3, 4, 5]]
    return stage(block=None, mesh=mesh(vertices, faces, bsdf=diffuse()))


def _degenerate_light() -> Scene:
    """Half of the lamp's triangles have no area."""
    vertices = [[-0.4, -0.4, 1.9], [0.4, -0.4, 1.9], [0, 0.4, 1.9]]
    faces = [[0, 2, 1], [0, 0, 1], [2, 2, 2]]
    return stage(light=mesh(vertices, faces, bsdf=diffuse(0.0), emitter=area(5.0)))


def _light_without_area() -> Scene:
    """Beside the lamp: its triangle is a point."""
    point = [[0.5, 0, 1.9]] * 3
    return stage(nothing=mesh(point, [[0, 1, 2]], bsdf=diffuse(0.0), emitter=area(5.0)))


def _medium() -> Scene:
    fog = {"type": "homogeneous", "albedo": 0.8, "sigma_t": 2.0}
    cloud = {"type": "cube", "to_world": translated(-0.4, 0, 0.6).scale(0.4), "interior": fog}
    return stage(cloud={**cloud, "bsdf": {"type": "null"}})


def _grazing(height: float) -> Scene:
    view = lookat([0, -4, height], [0, 0, height], [0, 0, 1])
    return stage(camera=sensor(to_world=view, fov=20.0))


def _small_lamp(radius: float) -> Scene:
    """A disk: Mitsuba's spheres are black below 2e-4 of their distance (the cosine is rounded)."""
    T = mi.ScalarTransform4f
    place = T().translate([-0.3, 0, 1.5]).rotate([1, 0, 0], 180).scale([radius, radius, 1])
    return stage(light={"type": "disk", "to_world": place, "emitter": area(1 / radius**2)})


def _film(*size: int, **changes: Any) -> Callable[[], Scene]:
    return lambda: stage(camera=sensor(film=film(*size, **changes)))


def _scaled(factor: float) -> Scene:
    scene = stage(mi.ScalarTransform4f().scale(factor))
    scene["sensor"].update(near_clip=1e-2 * factor, far_clip=1e4 * factor)
    return scene


HARD_CASES: dict[str, HardCase] = {
    "plain": HardCase(stage),
    # There, rays of Mitsuba's `path` start behind what is near
    "scaled_by_1e-3": HardCase(lambda: _scaled(1e-3), truth=stage),
    "scaled_by_1e4": HardCase(lambda: _scaled(1e4)),
    "moved_by_1e3_sizes": HardCase(lambda: stage(translated(3e3, -2e3, 1e3))),
    "radiance_1e-4": HardCase(lambda: stage(radiance=1e-4)),
    "radiance_1e6": HardCase(lambda: stage(radiance=1e6)),
    "lamp_of_radius_1e-4": HardCase(lambda: _small_lamp(1e-4)),
    "thousand_lights": HardCase(_many_lights),  # seconds to trace
    "no_light": HardCase(lambda: stage(light={}), is_black=True),
    "light_that_nothing_sees": HardCase(_hidden_light, is_black=True),
    "lights_seen_directly_only": HardCase(stage, max_depth=1, precision=0.03),
    "delta_lights": HardCase(_delta_lights),
    "directional_light": HardCase(
        lambda: stage(light={"type": "directional", "direction": [0.2, 0.4, -1]})
    ),
    "directional_area_light": HardCase(
        lambda: stage(light=rectangle(translated(0, 0, 3).rotate([1, 0, 0], 180),
                                      emitter={"type": "directionalarea"})),
        is_black=True,  # only paths from the light find it
    ),  # fmt: skip
    "constant_environment": HardCase(lambda: stage(light={"type": "constant"})),
    "sun_of_one_texel": HardCase(_sun_sky),
    "sky_through_portals": HardCase(_sky_through_portals),
    "textured_two_sided_lights": HardCase(_textured_two_sided_lights),
    "smooth_normal_lamp": HardCase(
        lambda: stage(light=octahedron(0.3, (-0.3, 0, 1.5), bsdf=diffuse(0), emitter=area(5.0)))
    ),
    "materials": HardCase(_materials),
    "mirror_ring": HardCase(mirror_ring, precision=0.03),
    "floor_under_water": HardCase(floor_under_water, precision=0.03),
    "light_through_a_hole": HardCase(light_through_a_hole, spp=2048, max_depth=6, precision=0.03),
    "bulb_under_a_shade": HardCase(bulb_under_a_shade, spp=2048, max_depth=8, precision=0.03),
    "grazing_camera": HardCase(lambda: _grazing(1e-3), precision=0.03),
    "closed_box": HardCase(_closed_box),
    "empty": HardCase(lambda: {"type": "scene", "sensor": sensor()}, is_black=True),
    "empty_before_environment": HardCase(
        lambda: {"type": "scene", "sensor": sensor(), "sky": {"type": "constant"}}
    ),
    "degenerate_triangles": HardCase(_degenerate_triangles),
    "degenerate_light": HardCase(_degenerate_light),
    "light_without_area": HardCase(_light_without_area),
    "instances": HardCase(_instances),
    "medium": HardCase(_medium, reference="volpath"),
    "film_of_one_pixel": HardCase(_film(1, 1), spp=65536, precision=0.03, seeds=6),
    "film_of_odd_size": HardCase(
        _film(37, 23, rfilter={"type": "gaussian"}), spp=256, unit=4
    ),
    "cropped_film": HardCase(
        _film(31, 29, crop_offset_x=5, crop_offset_y=9, crop_width=13, crop_height=11,
              rfilter={"type": "gaussian"}, sample_border=True), unit=3,
    ),  # fmt: skip
    "three_samples": HardCase(_film(64, 64), spp=3, precision=0.03),
    "one_sample": HardCase(_film(64, 64), spp=1, precision=0.05),
    "thousand_samples": HardCase(_film(11, 9), spp=1000, precision=0.03),
    "max_depth_0": HardCase(stage, max_depth=0, is_black=True),
    "max_depth_2": HardCase(stage, max_depth=2),
    "max_depth_unlimited": HardCase(stage, max_depth=-1),
    "thin_lens": HardCase(
        lambda: stage(camera=sensor("thinlens", aperture_radius=0.3, focus_distance=4.0))
    ),
    "hidden_emitters": HardCase(stage, parameters={"hide_emitters": True}),
    "hidden_environment": HardCase(
        lambda: stage(light={"type": "constant"}, wall=None), parameters={"hide_emitters": True}
    ),
}
