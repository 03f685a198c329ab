"""A small stage (a floor, a wall, a block that casts a shadow, a lamp) as a dictionary, and what
tests build variations of it from."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

Scene = dict[str, Any]


def rgb(*value: float) -> Scene:
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def diffuse(*value: float) -> Scene:
    return {"type": "diffuse", "reflectance": rgb(*(value or (0.6, 0.5, 0.4)))}


def area(radiance: float) -> Scene:
    return {"type": "area", "radiance": rgb(radiance)}


def bitmap(pixels: np.ndarray) -> mi.Bitmap:
    return mi.Bitmap(np.asarray(pixels, dtype=np.float32))


def lookat(origin: list, target: list, up: list) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(origin=origin, target=target, up=up)


def film(width: int = 16, height: int = 16, **changes: Any) -> Scene:
    return {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb",
            "rfilter": {"type": "box"}, **changes}  # fmt: skip


def sensor(
    plugin: str = "perspective",
    to_world: mi.ScalarTransform4f | None = None,
    sampler: str = "independent",
    film: Scene = film(),  # noqa: B008  (never modified)
    **changes: Any,
) -> Scene:
    """A camera that looks along +y at the stage."""
    optics = {"fov": 45.0} if plugin in ("perspective", "thinlens") else {}
    to_world = to_world or lookat([0, -4, 1.2], [0, 0, 0.6], [0, 0, 1])
    return {"type": plugin, "to_world": to_world, "film": film, "sampler": {"type": sampler},
            **optics, **changes}  # fmt: skip


def rectangle(*transforms: mi.ScalarTransform4f, **children: Any) -> Scene:
    to_world = mi.ScalarTransform4f()
    for transform in transforms:
        to_world = to_world @ transform
    return {"type": "rectangle", "to_world": to_world, **children}


def stage(
    transform: mi.ScalarTransform4f | None = None,
    light: Scene | None = None,
    radiance: float = 5.0,
    camera: Scene | None = None,
    **changes: Any,
) -> Scene:
    """A floor, a wall and a block under a small lamp, transformed (but not rotated) as a whole.

    Parameters:
        light: Replaces the lamp; an empty dictionary removes it.
        changes: Additional objects; ``None`` removes one.
    """
    T = mi.ScalarTransform4f
    world = transform or T()
    origin, target = (list(world @ mi.ScalarPoint3f(p)) for p in ([0, -4, 1.2], [0, 0, 0.6]))
    view = lookat(origin, target, [0, 0, 1])
    scene: Scene = {
        "type": "scene",
        "sensor": camera or sensor(to_world=view),
        "floor": rectangle(world, T().scale([2, 2, 1]), bsdf=diffuse()),
        "wall": rectangle(
            world, T().translate([0, 1.5, 1]).rotate([1, 0, 0], 90).scale([2, 1, 1]), bsdf=diffuse()
        ),
        "block": {
            "type": "cube",
            "to_world": world @ T().translate([0.5, 0, 0.4]).scale([0.3, 0.3, 0.4]),
            "bsdf": diffuse(0.3, 0.6, 0.3),
        },
        "light": light
        if light is not None
        else rectangle(
            world,
            T().translate([-0.3, 0, 1.9]).rotate([1, 0, 0], 180).scale([0.3, 0.3, 1]),
            bsdf=diffuse(0.0),
            emitter=area(radiance),
        ),
        **changes,
    }
    return {key: value for key, value in scene.items() if value not in (None, {})}


def translated(x: float, y: float, z: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate([x, y, z])


def mesh(vertices: list, faces: list, normals: list | None = None, **children: Any) -> mi.Mesh:
    """A triangle mesh from lists."""
    properties = mi.Properties()
    for name, child in children.items():
        properties[name] = mi.load_dict(child)
    shape = mi.Mesh(
        "mesh", len(vertices), len(faces), has_vertex_normals=normals is not None, props=properties
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(np.asarray(vertices, dtype=np.float32))
    parameters["faces"] = np.ravel(np.asarray(faces, dtype=np.uint32))
    if normals is not None:
        parameters["vertex_normals"] = np.ravel(np.asarray(normals, dtype=np.float32))
    parameters.update()
    return shape


def octahedron(radius: float, centre: tuple[float, float, float], **children: Any) -> mi.Mesh:
    """With smooth vertex normals: shading and geometric normals differ by up to 55 degrees."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return mesh((radius * corners + centre).tolist(), faces, corners.tolist(), **children)
