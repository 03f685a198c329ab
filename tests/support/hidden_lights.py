"""Small relatives of the scenes ring, pool, keyhole and shaded_lamp: no shadow ray finds the
light that they are about. Their lamps are large, so that ``path`` converges."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from tests.support.stage import Scene, area, diffuse, mesh, rectangle, stage


def mirror_ring() -> Scene:
    """The caustic inside of a mirror ring that stands on the floor."""
    ring = {"type": "cylinder", "p0": [0.2, -0.2, 0], "p1": [0.2, -0.2, 0.3], "radius": 0.5,
            "bsdf": {"type": "twosided", "bsdf": {"type": "conductor"}}}  # fmt: skip
    return stage(block=ring)


def floor_under_water() -> Scene:
    """Under waves from wall to wall: light and camera rays are both refracted."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-2, 2, 9)))
    z = 0.4 + 0.05 * np.sin(3 * x + y) * np.cos(2 * y)
    first = [9 * row + column for row in range(8) for column in range(8)]
    faces = [[i, i + 1, i + 10] for i in first] + [[i, i + 10, i + 9] for i in first]
    glass = {"type": "dielectric", "int_ior": "water"}
    return stage(water=mesh(np.stack([x, y, z], axis=1).tolist(), faces, bsdf=glass))


def light_through_a_hole() -> Scene:
    """The lamp, in a box with a hole of 60 cm in its floor, faces the box's ceiling."""
    T = mi.ScalarTransform4f
    white = {"type": "twosided", "bsdf": diffuse(0.8)}
    parts = {
        "left": ([-0.4, 0, 1.9], [0.1, 0.3, 0.02]),
        "right": ([0.4, 0, 1.9], [0.1, 0.3, 0.02]),
        "near": ([0, -0.4, 1.9], [0.5, 0.1, 0.02]),
        "far": ([0, 0.4, 1.9], [0.5, 0.1, 0.02]),
    }
    sides = {
        name: {"type": "cube", "to_world": T().translate(at).scale(half), "bsdf": white}
        for name, (at, half) in parts.items()
    }
    for turn in range(4):
        upright = T().rotate([0, 0, 1], 90 * turn).translate([0, 0.5, 2.3])
        sides[f"side_{turn}"] = rectangle(
            upright, T().rotate([1, 0, 0], 90).scale([0.5, 0.4, 1]), bsdf=white
        )
    roof = rectangle(T().translate([0, 0, 2.7]).scale([0.5, 0.5, 1]), bsdf=white)
    lamp = rectangle(
        T().translate([0.4, 0, 1.95]).scale([0.1, 0.3, 1]), bsdf=diffuse(0.0), emitter=area(20.0)
    )
    return stage(light=lamp, roof=roof, **sides)


def bulb_under_a_shade() -> Scene:
    """A glowing ball in a shell of glass, in a cylinder open at both ends."""
    centre = [-0.3, 0, 1.5]
    glass = {"type": "dielectric", "int_ior": "bk7", "ext_ior": "air"}
    air = {"type": "dielectric", "int_ior": "air", "ext_ior": "bk7"}
    shade = {"type": "cylinder", "p0": [-0.3, 0, 1.2], "p1": [-0.3, 0, 1.8], "radius": 0.45,
             "bsdf": {"type": "twosided", "bsdf": diffuse(0.8)}}  # fmt: skip
    shell = {
        f"shell_{side}": {"type": "sphere", "center": centre, "radius": radius, "bsdf": bsdf}
        for side, radius, bsdf in (("outside", 0.3, glass), ("inside", 0.27, air))
    }
    lamp = {"type": "sphere", "center": centre, "radius": 0.2, "bsdf": diffuse(0.0)}
    return stage(light={**lamp, "emitter": area(8.0)}, shade=shade, **shell)
