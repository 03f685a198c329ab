"""Finds small transparent objects with another surface close behind theirs. Rays start at an offset
from the surface that they leave: there, they would start behind both.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy

#: Objects count as small if they are smaller than this many offsets.
_SMALL = 1000

#: Lines through the box of each object; surfaces that are looked at on each line; and the share of
#: lines that must meet two close ones. Near an edge of an object, any two of its faces are close.
_LINES, _SURFACES, _SHARE = 64, 4, 1 / 4

#: The distance of close surfaces, in offsets, on a line that crosses them at an angle.
_NEAR = 1.5

#: The most objects that are examined, evenly spread over the list of shapes.
_MOST = 256

#: What is a small part of an offset.
_STEP = 1 / 32

#: Shapes whose intersections are exact up to a few rounding errors, besides meshes.
_EXACT = ("Sphere", "Disk", "Rectangle")


def has_near_surfaces(scene: mi.Scene, offset: Callable[[float], float]) -> bool:
    """Is another surface closer to a small transparent object of ``scene`` than the offset
    of rays? It is false, too, where intersections are not exact enough for a smaller offset: on a
    GPU, and where there are shapes other than meshes, spheres, disks and rectangles. Meshes that
    Mitsuba has merged count as one object.

    Parameters:
        offset: The offset of rays at points whose largest coordinate is given.
    """
    shapes = scene.shapes()
    if "llvm" not in mi.variant():
        return False
    if not all(shape.is_mesh() or shape.class_name() in _EXACT for shape in shapes):
        return False
    small = []
    for shape in shapes:
        box = shape.bbox()
        if shape.is_emitter() or not box.valid() or not _lets_through(shape):
            continue
        distance = offset(float(np.abs([box.min, box.max]).max()))
        if 0 < max(box.extents()) < _SMALL * distance:
            small.append((*box.min, *box.max, distance))
    small = small[:: -(-len(small) // _MOST) or 1]
    return bool(small) and _are_near(scene, np.array(small, dtype=np.float32))


def _lets_through(shape: mi.Shape) -> bool:
    """May rays pass through the surface of ``shape``?"""
    passes, bsdf = int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null), shape.bsdf()
    return bsdf is not None and int(bsdf.flags()) & passes != 0


def _are_near(scene: mi.Scene, small: np.ndarray) -> bool:
    """Do lines through one of these boxes meet surfaces close to each other? A row has both corners
    of a box, and the offset there."""
    numbers = np.random.default_rng(1)
    rows = np.repeat(small, _LINES, axis=0)
    low, high, offset = rows[:, :3], rows[:, 3:6], rows[:, 6]
    d = numbers.normal(size=low.shape)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    p = low + numbers.random(low.shape) * (high - low)
    o = p - np.linalg.norm(high - low, axis=1, keepdims=True) * d
    ray = mi.Ray3f(*(kind(*(from_numpy(mi.Float, column) for column in values.T))
                     for kind, values in ((mi.Point3f, o), (mi.Vector3f, d))))  # fmt: skip
    offset = from_numpy(mi.Float, offset)
    step = _STEP * offset
    near, going = mi.Bool(False), mi.Bool(True)
    for index in range(_SURFACES):
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=going)
        going &= pi.is_valid()
        if index > 0:
            # What is not farther than a step may be the same surface
            near |= going & (pi.t > step) & (pi.t < _NEAR * offset)
        ray.o = ray(dr.select(going, pi.t + step, 0))
        dr.eval(ray, near, going)
    share = np.array(near).reshape(-1, _LINES).mean(axis=1)
    return bool(share.max() >= _SHARE)
