"""Small scenes with fog, for ``fog.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

import mitsuba_ext  # noqa: F401  (chooses an LLVM library that works: before mitsuba)

import mitsuba as mi  # isort: skip

Scene = dict[str, Any]


def _t() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def _rgb(*value: float) -> Scene:
    return {"type": "rgb", "value": list(value)}


def _diffuse(*value: float) -> Scene:
    return {"type": "diffuse", "reflectance": _rgb(*value)}


def _area(*value: float) -> Scene:
    return {"type": "area", "radiance": _rgb(*value)}


def _wall(bsdf: Scene, *transforms: mi.ScalarTransform4f, **other: Any) -> Scene:
    place = _t()
    for transform in transforms:
        place = place @ transform
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "bsdf": bsdf},
            **other}  # fmt: skip


def _foggy(
    width: int, height: int, origin: list, target: list, sigma_t: float, radius: float,
    **objects: Scene,
) -> Scene:  # fmt: skip
    """A camera in a ball of fog."""
    fog = {"type": "homogeneous", "id": "around", "albedo": 0.9, "sigma_t": sigma_t,
           "phase": {"type": "hg", "g": 0.3}}  # fmt: skip
    ref = {"type": "ref", "id": "around"}
    return {
        "type": "scene", "around": fog, "sensor": _camera(width, height, origin, target, ref),
        "ball": {"type": "sphere", "radius": radius, "bsdf": {"type": "null"}, "interior": ref},
        **objects,
    }  # fmt: skip


def _camera(
    width: int, height: int, origin: list, target: list, medium: Scene | None = None
) -> Scene:
    view = _t().look_at(origin=origin, target=target, up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb",
            "rfilter": {"type": "box"}}  # fmt: skip
    inside = {"medium": medium} if medium else {}
    return {"type": "perspective", "fov": 50, "to_world": view, "film": film,
            "sampler": {"type": "independent"}, **inside}  # fmt: skip


def bulb(width: int, height: int) -> Scene:
    """A small lamp in a bulb of glass, above a floor."""
    ref, centre = {"type": "ref", "id": "around"}, [0, 0, 1]
    return _foggy(
        width, height, [0, -4, 1.2], [0, 0, 0.8], 0.05, 5.0,
        floor=_wall(_diffuse(0.5, 0.45, 0.4), _t().scale(6)),
        lamp={"type": "sphere", "center": centre, "radius": 0.05,
              "emitter": _area(600, 480, 360)},
        glass={"type": "sphere", "center": centre, "radius": 0.4, "exterior": ref,
               "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}},
        air={"type": "sphere", "center": centre, "radius": 0.36,
             "bsdf": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.5}},
    )  # fmt: skip


def sun(width: int, height: int) -> Scene:
    """Sun and sky through a window, into a room."""
    white = _diffuse(0.7, 0.7, 0.7)
    right = _t().translate([2, 0, 0]).rotate([0, 1, 0], -90)
    # The window is 1 wide and 1.2 high
    pieces = {
        f"right_{k}": _wall(white, right, _t().translate([z, y, 0]), _t().scale([h, w, 1]))
        for k, (z, y, h, w) in enumerate(
            [(0.4, 0, 0.4, 3), (2.5, 0, 0.5, 3), (1.4, -1.75, 0.6, 1.25), (1.4, 1.75, 0.6, 1.25)]
        )
    }
    return _foggy(
        width, height, [-1.2, -2.8, 1.4], [0.4, 0.4, 1.2], 0.15, 12.0,
        floor=_wall(_diffuse(0.5, 0.4, 0.3), _t().scale([2, 3, 1])),
        ceiling=_wall(white, _t().translate([0, 0, 3]).scale([2, 3, 1])),
        left=_wall(white, _t().translate([-2, 0, 1.5]).rotate([0, 1, 0], 90).scale([1.5, 3, 1])),
        back=_wall(white, _t().translate([0, 3, 1.5]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        front=_wall(white, _t().translate([0, -3, 1.5]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        sun={"type": "directional", "direction": [-1, 0.2, -0.8], "irradiance": _rgb(12, 11, 9)},
        sky={"type": "constant", "radiance": _rgb(0.3, 0.4, 0.6)},
        **pieces,
    )  # fmt: skip


def soft(width: int, height: int) -> Scene:
    """A large lamp above blocks."""
    blocks = {
        f"block_{k}": {"type": "cube", "bsdf": _diffuse(0.6, 0.3 + 0.1 * k, 0.3),
                       "to_world": _t().translate([k - 1.5, 0.4 * k, 0.4]).scale(0.3)}
        for k in range(4)
    }  # fmt: skip
    return _foggy(
        width, height, [0, -5, 1.8], [0, 0, 0.6], 0.12, 9.0,
        floor=_wall(_diffuse(0.5, 0.5, 0.5), _t().scale(8)),
        lamp={"type": "rectangle", "emitter": _area(3, 2.8, 2.5),
              "to_world": _t().translate([0, 0, 4]).rotate([1, 0, 0], 180).scale(2)},
        **blocks,
    )  # fmt: skip


def smoke(width: int, height: int) -> Scene:
    """A cloud of random density above a floor, under a lamp and a sky."""
    noise = np.random.default_rng(3).random((12, 12, 12), dtype=np.float32)
    z, y, x = (np.indices(noise.shape) - 5.5) / 6
    density = np.maximum(0, 1.2 - x**2 - y**2 - z**2) * noise * 12
    place = _t().translate([-1, -1, 0.1]).scale(2)
    medium = {
        "type": "heterogeneous", "albedo": 0.8,
        "sigma_t": {"type": "gridvolume", "to_world": place,
                    "grid": mi.VolumeGrid(density[..., None].astype(np.float32))},
    }  # fmt: skip
    return {
        "type": "scene", "sensor": _camera(width, height, [0, -5, 1.8], [0, 0, 0.9]),
        "cube": {"type": "cube", "to_world": _t().translate([0, 0, 1.1]), "interior": medium,
                 "bsdf": {"type": "null"}},
        "floor": _wall(_diffuse(0.5, 0.5, 0.5), _t().scale(5)),
        "lamp": {"type": "sphere", "center": [2, -1, 3.5], "radius": 0.3,
                 "emitter": _area(40, 36, 30)},
        "sky": {"type": "constant", "radiance": _rgb(0.1, 0.15, 0.25)},
    }  # fmt: skip


def dark_room(width: int, height: int) -> Scene:
    """A room with a small opening, in bright fog."""
    grey = _diffuse(0.4, 0.4, 0.4)
    up = _t().translate([0, 0, 1.5])
    return _foggy(
        width, height, [0, -1.8, 1.2], [0, 0.6, 1.2], 0.15, 10.0,
        floor=_wall(grey, _t().scale(2)),
        ceiling=_wall(grey, _t().translate([0, 0, 3]).scale(2)),
        left=_wall(grey, up, _t().translate([-2, 0, 0]).rotate([0, 1, 0], 90).scale([1.5, 2, 1])),
        back=_wall(grey, up, _t().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        front=_wall(grey, up, _t().translate([0, -2, 0]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        right=_wall(grey, up, _t().translate([2, -0.3, 0]).rotate([0, 1, 0], 90)
                    .scale([1.5, 1.7, 1])),
        lamp={"type": "sphere", "center": [5, 3, 4], "radius": 0.8, "emitter": _area(60, 60, 50)},
    )  # fmt: skip


def mirrored_beam(width: int, height: int) -> Scene:
    """A foggy room with a lamp. A ball of glass bundles the light of a smaller lamp into a beam,
    which a mirror shows too."""
    white, ref = _diffuse(0.6, 0.6, 0.6), {"type": "ref", "id": "around"}
    mirror = {"type": "conductor", "material": "none"}
    up = _t().translate([0, 0, 1.5])
    return _foggy(
        width, height, [-1.2, -2.6, 1.3], [0.6, 0.8, 1.2], 0.12, 10.0,
        floor=_wall(_diffuse(0.5, 0.4, 0.3), _t().scale([2, 3, 1])),
        ceiling=_wall(white, _t().translate([0, 0, 3]).scale([2, 3, 1])),
        left=_wall(white, up, _t().translate([-2, 0, 0]).rotate([0, 1, 0], 90).scale([1.5, 3, 1])),
        back=_wall(white, up, _t().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        front=_wall(white, up, _t().translate([0, -3, 0]).rotate([1, 0, 0], 90).scale([2, 1.5, 1])),
        right=_wall(mirror, up, _t().translate([2, 0, 0]).rotate([0, 1, 0], -90)
                    .scale([1.5, 3, 1])),
        lamp={"type": "rectangle", "emitter": _area(1.2, 1.3, 1.5),
              "to_world": _t().translate([0, 0, 2.98]).rotate([1, 0, 0], 180).scale(0.4)},
        small_lamp={"type": "disk", "emitter": _area(2000, 1600, 1000),
                    "to_world": _t().look_at([-0.6, 1.2, 2.6], [0.2, 0.8, 1.7], [0, 0, 1])
                    .scale(0.04)},
        glass={"type": "sphere", "center": [-0.2, 1, 2.15], "radius": 0.3, "exterior": ref,
               "bsdf": {"type": "dielectric"}},
        # Its light leaves through the glass alone
        shade={"type": "cylinder", "p0": [-0.62, 1.21, 2.6225], "p1": [-0.28, 1.04, 2.24],
               "radius": 0.2, "bsdf": {"type": "twosided", "bsdf": _diffuse(0, 0, 0)}},
    )  # fmt: skip


#: Makes a scene with a film of the given width and height.
FOGS = {f.__name__: f for f in (bulb, sun, soft, smoke, dark_room, mirrored_beam)}
