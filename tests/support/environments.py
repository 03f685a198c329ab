"""Environments of every kind, a floor below them, and directions to test densities with."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Samples of a density.
LANES = 1 << 17


def _map(image: np.ndarray, **more) -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(np.float32(image)), **more}


def _random(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(1).random((height, width, 3))


def _with_sun(row: int) -> np.ndarray:
    image = 0.1 * _random(32, 64)
    image[row, 20] = 1e5
    return image


def _sun_on_the_seam() -> np.ndarray:
    image = 0.1 * _random(32, 64)
    image[12, 0] = 1e5
    return image


def _black_halves() -> np.ndarray:
    """The upper one, and the left one of the lower."""
    image = _random(24, 48)
    image[:12] = 0
    image[12:, :24] = 0
    return image


def _half_black() -> np.ndarray:
    image = np.zeros((16, 33, 3))
    image[3:9, 4:12] = _random(6, 8)
    return image


def _turned():
    return mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 70).rotate([0, 1, 0], 130)


ENVIRONMENTS = {
    "constant": lambda: {"type": "constant", "radiance": 2.0},
    "turned": lambda: _map(_random(40, 81), to_world=_turned()),
    "mirrored": lambda: _map(_random(9, 16), to_world=mi.ScalarTransform4f().scale([-1, 1, 1])),
    "sun": lambda: _map(_with_sun(11)),
    "sun in the zenith": lambda: _map(_with_sun(0)),
    "half black": lambda: _map(_half_black()),
    "smallest": lambda: _map(_random(3, 2)),
    "odd": lambda: _map(_random(5, 7)),
    "sky": lambda: {"type": "sunsky", "sun_direction": [1, 1, 1], "to_world": _turned()},
    "sunset": lambda: {"type": "sunsky", "sun_direction": [1, 0, 0.02]},
    "sky without sun": lambda: {"type": "sunsky", "sun_scale": 0.0},
}

#: For decisions that look at whole maps.
MORE_ENVIRONMENTS = {
    **ENVIRONMENTS,
    "one texel": lambda: _map(np.ones((1, 1, 3))),
    "sun on the seam": lambda: _map(_sun_on_the_seam()),
    "black halves": lambda: _map(_black_halves(), to_world=_turned()),
}


def _direction(u: float, v: float) -> list[float]:
    """The direction of a point of a map."""
    phi, theta = 2 * np.pi * u, np.pi * v
    d = [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    return [float(x) for x in d]


#: Axis and half angle, in degrees, of the cone that holds what is small and bright.
SPOTS = {
    "sun": (_direction(20.5 / 64, 11 / 31), 9),
    "sun on the seam": (_direction(0.5 / 64, 12 / 31), 9), "sun in the zenith": ([0, 1, 0], 9),
    "sky": ([1, 1, 1], 0.4), "sunset": ([1, 0, 0.02], 0.4),
}  # fmt: skip


def random_point(numbers: mi.PCG32) -> mi.Point2f:
    return mi.Point2f(numbers.next_float32(), numbers.next_float32())


BSDFS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse"},
    "metal": {"type": "roughconductor", "alpha": 0.15},
    "brushed": {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.5},
    "coated": {"type": "roughplastic", "alpha": 0.1},
    "glass": {"type": "roughdielectric", "alpha": 0.3},
    # Nothing of it can be known beforehand
    "mirror": {"type": "conductor"},
}


def floor_below(environment: str, bsdf: str) -> mi.Scene:
    """A floor of a material of :data:`BSDFS` below an environment."""
    return mi.load_dict({
        "type": "scene", "e": MORE_ENVIRONMENTS[environment](),
        "floor": {"type": "rectangle", "bsdf": BSDFS[bsdf]},
    })  # fmt: skip


def floor_vertex(scene: mi.Scene, lanes: int = LANES) -> mi.SurfaceInteraction3f:
    """The same point of the floor in each lane."""
    origin = mi.Point3f(0.3, -1, 1)
    si = scene.ray_intersect(mi.Ray3f(origin, dr.normalize(-mi.Vector3f(origin))))
    return dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, lanes))


def directions_everywhere(name: str, numbers: mi.PCG32) -> tuple[mi.Vector3f, mi.Float]:
    """Directions on the whole sphere, half of them in the spot, and their density."""
    d = mi.warp.square_to_uniform_sphere(random_point(numbers))
    if name not in SPOTS:
        return d, dr.full(mi.Float, dr.inv_four_pi, LANES)
    axis, degrees = SPOTS[name]
    cosine = float(np.cos(np.radians(degrees)))
    axis = dr.normalize(mi.Vector3f(axis))
    cone = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(random_point(numbers), cosine))
    d = dr.select(numbers.next_float32() < 0.5, cone, d)
    # The sine: precise for small angles
    in_cone = dr.norm(dr.cross(d, axis)) < float(np.sin(np.radians(degrees)))
    in_cone &= dr.dot(d, axis) > 0
    area = 2 * np.pi * (1 - np.cos(np.radians(degrees)))
    return d, 0.5 * dr.inv_four_pi + dr.select(in_cone, float(0.5 / area), 0)
