"""Hashes of scenes and their parts that are the same in every process."""

from __future__ import annotations

import hashlib

import drjit as dr
import mitsuba as mi
import numpy as np

from ..util.arrays import host_copy
from .parameter_values import values_of


def fingerprint(scene: mi.Scene) -> str:
    """A hash of shapes, materials and lights, without sensors and films."""
    # Sorted because the order differs each time a scene is loaded
    digests = sorted(digest(part) for part in [*scene.shapes(), *scene.emitters()])
    return hashlib.sha256(b"".join(digests)).hexdigest()


def digest(scene_object: mi.Object) -> bytes:
    """A hash of the class and the parameters of a shape, an emitter or a material."""
    state = hashlib.sha256(scene_object.class_name().encode())
    for key, value in sorted(values_of(mi.traverse(scene_object)), key=lambda pair: pair[0]):
        state.update(key.encode())
        if dr.is_tensor_v(value):
            value = value.array
        state.update(np.ascontiguousarray(host_copy(value)).tobytes() if dr.is_array_v(value)
                     else repr(value).encode())
    return state.digest()


def sensor_digest(sensor: mi.Sensor) -> str:
    """A hash of a sensor's class, its motion, and its named parameters."""
    values = mi.traverse(sensor)
    motion = getattr(sensor, "motion", "")
    text = "".join(f"{key}={values[key]}" for key in sorted(values.keys()))
    return hashlib.sha256(f"{sensor.class_name()} {motion} {text}".encode()).hexdigest()[:16]
