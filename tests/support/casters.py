"""Small scenes with surfaces that cast caustics."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

GLASS = {"type": "dielectric", "int_ior": 1.5}
MIRROR = {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}}
ROUGH_GLASS = {"type": "roughdielectric", "int_ior": 1.5, "alpha": 0.1, "distribution": "ggx"}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}


def plane_at(height: float, bsdf: dict, size: float = 2.0, down: bool = False) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().translate([0, 0, height]).scale(size)
    if down:
        to_world = to_world @ mi.ScalarTransform4f().rotate([1, 0, 0], 180)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


def lamp_above(size: float = 0.3) -> dict[str, Any]:
    lamp = plane_at(2.0, GREY, size, down=True)
    return {**lamp, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 40.0}}}


def camera_at(origin: list[float], target: list[float], size: int = 8, fov: float = 30.0) -> Any:
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film}


def scene_of(**parts: Any) -> mi.Scene:
    sensor = parts.pop("sensor", camera_at([0.2, -2.5, 2.5], [0, 0, 0], fov=45.0))
    return mi.load_dict({"type": "scene", "sensor": sensor, **parts})


def wavy_surface(with_coordinates: bool) -> mi.Mesh:
    """A curved surface of 72 triangles with interpolated normals."""
    count = 7
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count), indexing="ij")
    corners = np.stack([x, y, 0.2 * np.sin(2 * x) * np.cos(y)], -1).reshape(-1, 3)
    index = np.arange(count**2).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    bsdf = mi.load_dict({"type": "dielectric"})
    props = mi.Properties()
    props["bsdf"] = bsdf
    mesh = mi.Mesh("wavy", count**2, len(faces), props=props, has_vertex_normals=True,
                   has_vertex_texcoords=with_coordinates)  # fmt: skip
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(corners.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    if with_coordinates:
        turned = corners[:, :2] @ np.array([[0.3, 0.8], [-2.0, 0.1]])
        parameters["vertex_texcoords"] = mi.Float(turned.astype(np.float32).ravel())
    parameters.update()
    return mesh
