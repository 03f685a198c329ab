"""Finds small transparent objects with another surface close behind theirs. Rays start at an offset
from the surface that they leave, and would there start behind both surfaces.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import from_numpy

#: The maximum size of a small object, in offsets.
_MAX_SIZE = 1000

#: The number of lines through the box of each object, the number of surfaces examined on each line,
#: and the fraction of lines that must meet two close surfaces. Near an edge of an object, any two
#: of its faces are close.
_LINES, _SURFACES, _MIN_FRACTION = 64, 4, 1 / 4

#: The maximum distance of close surfaces, in offsets, along a line that crosses them at an angle.
_MAX_DISTANCE = 1.5

#: The maximum number of objects examined, evenly spread over the list of shapes.
_MAX_OBJECTS = 256

#: The step past a surface, as a fraction of an offset.
_STEP = 1 / 32

#: Shapes whose intersections are exact up to a few rounding errors, besides meshes.
_EXACT_SHAPES = ("Sphere", "Disk", "Rectangle")


def has_near_surfaces(scene: mi.Scene, offset: Callable[[float], float]) -> bool:
    """Whether another surface is closer to a small transparent object of ``scene`` than the offset
    of rays. Also false if intersections are not exact enough for a smaller offset: on a GPU, and if
    there are shapes other than meshes, spheres, disks and rectangles. Meshes that Mitsuba has
    merged count as one object.

    Parameters:
        offset: A function of a point's largest coordinate that returns the offset of rays there.
    """
    shapes = scene.shapes()
    if "llvm" not in mi.variant():
        return False
    if not all(shape.is_mesh() or shape.class_name() in _EXACT_SHAPES for shape in shapes):
        return False
    small = []
    for shape in shapes:
        box = shape.bbox()
        if shape.is_emitter() or not box.valid() or not _lets_through(shape):
            continue
        distance = offset(float(np.abs([box.min, box.max]).max()))
        if 0 < max(box.extents()) < _MAX_SIZE * distance:
            small.append((*box.min, *box.max, distance))
    small = small[:: -(-len(small) // _MAX_OBJECTS) or 1]
    return bool(small) and _are_near(scene, np.array(small, dtype=np.float32))


def _lets_through(shape: mi.Shape) -> bool:
    """Whether rays may pass through the surface of ``shape``."""
    passes, bsdf = int(mi.BSDFFlags.Transmission) | int(mi.BSDFFlags.Null), shape.bsdf()
    return bsdf is not None and int(bsdf.flags()) & passes != 0


def _are_near(scene: mi.Scene, small: np.ndarray) -> bool:
    """Whether lines through any of these boxes meet surfaces that are close together. A row has the
    two corners of a box and the offset there."""
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
            # A hit within a step may be on the same surface
            near |= going & (pi.t > step) & (pi.t < _MAX_DISTANCE * offset)
        ray.o = ray(dr.select(going, pi.t + step, 0))
        dr.eval(ray, near, going)
    share = np.array(near).reshape(-1, _LINES).mean(axis=1)
    return bool(share.max() >= _MIN_FRACTION)
