"""A light that is sampled by solid angle, points around it, and random numbers for each of them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from tests.support.stage import rgb

NAME = "solid_angle_area"

#: In units of the size of the light.
DISTANCES = [1e-3, 1e-2, 0.1, 0.5, 1, 10, 1e2, 1e4]

#: Where points lie: along the normal; obliquely; almost in the plane of the light.
WAYS = [(0.1, 0.05, 1.0), (0.6, -0.5, 0.6), (0.9, 0.4, 2e-3)]

SAMPLES = 1 << 13

#: Less probable than this is an error.
UNLIKELY = 1e-6


def light(shape: dict[str, Any], radiance: Any = None, **parameters: Any) -> mi.Scene:
    """A scene of one light, which must be kept: an emitter does not keep its shape."""
    emitter = {"type": NAME, "radiance": radiance or rgb(1.0), **parameters}
    return mi.load_dict({"type": "scene", "light": {**shape, "emitter": emitter}})


def turned() -> mi.ScalarTransform4f:
    T = mi.ScalarTransform4f
    return T().rotate([0.6, 0.8, 0], 130).rotate([0, 0, 1], 20)


def lanes(points: np.ndarray, seed: int = 1) -> tuple[mi.Interaction3f, mi.Point2f]:
    """``SAMPLES`` lanes for each point, with random numbers."""
    it = dr.zeros(mi.Interaction3f, SAMPLES * len(points))
    it.p = mi.Point3f(np.repeat(points, SAMPLES, axis=0).T.astype(np.float32))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, SAMPLES * len(points))
    return it, sampler.next_2d()


def seen_from(centre: np.ndarray, axes: np.ndarray, gap: float = 0.0) -> np.ndarray:
    """Points around a light of size 1, rounded to floats."""
    points = [
        centre + axes @ (np.array(way) * distance + gap * np.array(way) / np.linalg.norm(way))
        for distance in DISTANCES for way in WAYS
    ]  # fmt: skip
    return np.array(points).astype(np.float32).astype(np.float64)


SHAPES: dict[str, dict[str, Any]] = {
    "rectangle": {"type": "rectangle"},
    "disk": {"type": "disk"},
    "ellipse": {"type": "disk", "to_world": "squeezed"},
    "sphere": {"type": "sphere"},
    "cube": {"type": "cube"},
}


def shape(name: str, transform: mi.ScalarTransform4f | None = None, **changes: Any) -> dict:
    base = dict(SHAPES[name])
    transform = transform or mi.ScalarTransform4f()
    if base.pop("to_world", None):
        transform = transform @ mi.ScalarTransform4f().scale([1, 0.4, 1])
    return {**base, "to_world": transform, **changes}
