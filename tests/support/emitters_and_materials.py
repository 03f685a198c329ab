"""The stage with every kind of emitter and material, for integrators with light paths."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.stage import area, bitmap, diffuse, lookat, mesh, sensor, stage


def T() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def below_the_lamp(plugin: str = "perspective", **changes: Any) -> dict[str, Any]:
    """A camera that does not see the lamp, whose edges would be most of the noise."""
    view = lookat([0, -4, 1.2], [0, 0, 0.3], [0, 0, 1])
    return sensor(plugin, **{"to_world": view, "fov": 35.0, **changes})


def _pixels(height: int = 4, width: int = 6) -> np.ndarray:
    return np.random.default_rng(3).uniform(0.5, 5, (height, width, 3))


def _texture() -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": bitmap(_pixels()), "raw": True, "filter_type": "nearest"}


def _turned(size: float = 0.4) -> mi.ScalarTransform4f:
    return T().translate([-0.3, 0, 1.9]).rotate([0, 1, 0], 165).rotate([1, 0, 0], 30).scale(size)


def _lamp(shape: str, radiance: Any = None, size: float = 0.4, **more: Any) -> dict[str, Any]:
    emitter = area(3.0) if radiance is None else {"type": "area", "radiance": radiance}
    return {"type": shape, "to_world": _turned(size), "bsdf": diffuse(0.0), "emitter": emitter,
            **more}  # fmt: skip


def _mirrored(shape: str) -> dict[str, Any]:
    """Its triangles are wound the other way; its vertex normals are not."""
    return _lamp(shape, to_world=_turned() @ T().scale([-1, 1, 1]))


def _wound_both_ways() -> mi.Mesh:
    """A square whose vertex normals all face down. So does one of its two triangles."""
    corners = [[-0.7, -0.4, 1.9], [0.1, -0.4, 1.9], [0.1, 0.4, 1.9], [-0.7, 0.4, 1.9]]
    return mesh(corners, [[0, 1, 2], [0, 3, 2]], 4 * [[0, 0, -1]], bsdf=diffuse(0.0),
                emitter=area(3.0))  # fmt: skip


def _down() -> mi.ScalarTransform4f:
    return lookat([-0.7, -1, 2.5], [0, 0.2, 0], [0, 0, 1])


EMITTERS = {
    "rectangle": lambda: _lamp("rectangle"),
    "disk": lambda: _lamp("disk"),
    "sphere": lambda: _lamp("sphere"),
    "cylinder": lambda: _lamp("cylinder"),
    "cube": lambda: _lamp("cube"),
    "textured rectangle": lambda: _lamp("rectangle", _texture()),
    "mirrored cube": lambda: _mirrored("cube"),
    "mirrored rectangle": lambda: _mirrored("rectangle"),
    "mirrored disk": lambda: _mirrored("disk"),
    "square wound both ways": _wound_both_ways,
    "point": lambda: {"type": "point", "position": [0.8, -1, 1.5]},
    "spot": lambda: {"type": "spot", "to_world": _down(), "cutoff_angle": 35.0},
    "textured spot": lambda: {"type": "spot", "to_world": _down(), "texture": _texture()},
    "projector": lambda: {"type": "projector", "to_world": _down(), "irradiance": _texture()},
    "directional": lambda: {"type": "directional", "direction": [0.2, 0.4, -1]},
    "constant": lambda: {"type": "constant"},
    "envmap": lambda: {"type": "envmap", "bitmap": bitmap(_pixels(8, 16)),
                       "to_world": T().rotate([1, 0, 0], 90)},
    "sunsky": lambda: {"type": "sunsky", "to_world": T().rotate([1, 0, 0], 90),
                       "sun_scale": 0.0},
}  # fmt: skip

#: Where next event estimation of ``path`` itself errs: found by BSDF samples.
UNLIKE_PATH = {
    "textured turned sphere": lambda: _lamp("sphere", _texture()),
    "textured turned cylinder": lambda: _lamp("cylinder", _texture()),
    "textured cube": lambda: _lamp("cube", _texture()),
}


def stage_with_ball(bsdf: dict[str, Any]) -> dict[str, Any]:
    """The stage with a ball of a material in the place of the block."""
    return stage(
        block={"type": "sphere", "center": [0.4, 0, 0.5], "radius": 0.4, "bsdf": bsdf},
        camera=below_the_lamp(),
    )


def _bumps(kind: str) -> dict[str, Any]:
    pixels = np.random.default_rng(2).uniform(0, 0.1, (8, 8, 1))
    if kind == "bumpmap":
        bumps = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
        return {"type": "bumpmap", "arbitrary": bumps, "bsdf": diffuse()}
    normals = {"type": "bitmap", "bitmap": bitmap(np.full((2, 2, 3), [0.6, 0.4, 0.9])),
               "raw": True}  # fmt: skip
    return {"type": "normalmap", "normalmap": normals,
            "bsdf": {"type": "roughconductor", "alpha": 0.3}}  # fmt: skip


MATERIALS = {
    "normalmap": lambda: _bumps("normalmap"),
    "bumpmap": lambda: _bumps("bumpmap"),
    "twosided plastic": lambda: {"type": "twosided", "bsdf": {"type": "roughplastic"}},
    "rough glass": lambda: {"type": "roughdielectric", "alpha": 0.3},
    "principled": lambda: {"type": "principled", "spec_trans": 0.7, "roughness": 0.4},
}


def shiny_things() -> dict[str, Any]:
    """A ball of glass, a mirror, and a rough one; a ball with a diffuse and a delta lobe."""
    T = mi.ScalarTransform4f
    ball = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    plastic = {"type": "sphere", "center": [-0.8, 0.2, 0.3], "radius": 0.3,
               "bsdf": {"type": "plastic"}}  # fmt: skip
    rough = {"type": "sphere", "center": [0.9, 0.2, 0.3], "radius": 0.3,
             "bsdf": {"type": "roughconductor", "alpha": 0.2}}  # fmt: skip
    mirror = {"type": "rectangle", "bsdf": {"type": "conductor"},
              "to_world": T().translate([0, 1.4, 0.5]).rotate([1, 0, 0], 90)}  # fmt: skip
    return {"ball": ball, "plastic": plastic, "rough": rough, "mirror": mirror}


SPECULAR = {
    "glass": lambda: {"type": "dielectric"},
    "mirror": lambda: {"type": "conductor"},
    "plastic": lambda: {"type": "plastic"},
    "mask": lambda: {"type": "mask", "opacity": 0.4, "bsdf": diffuse()},
}
