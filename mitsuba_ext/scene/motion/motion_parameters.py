"""The parameters of a motion, which all moving plugins share: a displacement and a turn, or poses
at times. The page of the shape ``moving`` describes them."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np

from ...util.parameters import read_parameter
from .rigid_motion import Motion

if TYPE_CHECKING:
    import mitsuba as mi

#: The maximum deviation of a pose from a rigid one: matrices in text files are rounded.
_RIGID_TOLERANCE = 1e-4


def read_motion(plugin: str, props: mi.Properties) -> Motion:
    """Reads the motion that the parameters of a plugin describe.

    Parameters:
        plugin: Name of the plugin, for errors.
        props: The plugin's properties.

    Raises:
        TypeError, ValueError: A parameter is wrong or missing, or two parameters exclude each
            other.
    """
    keys = sorted(key for key in props.keys() if re.fullmatch(r"(pose|time)_\d+", key))
    simple = [k for k in ("translate", "axis", "angle", "begin", "end") if k in props]
    if keys and simple:
        raise ValueError(
            f'"{plugin}": the parameters "{simple[0]}" and "{keys[0]}" cannot be combined: give a '
            f"displacement and a turn, or poses at times"
        )
    return _keyed(plugin, props, keys) if keys else _uniform(plugin, props)


def _uniform(plugin: str, props: mi.Properties) -> Motion:
    if "translate" not in props and "axis" not in props:
        raise ValueError(
            f'"{plugin}": no motion is given: set "translate", "axis" and "angle", or "pose_0", '
            f'"time_0", …'
        )
    begin = read_parameter(plugin, props, "begin", 0.0)
    end = read_parameter(plugin, props, "end", 1.0)
    if not begin < end:
        raise ValueError(
            f'"{plugin}": "begin" is {begin:g} and must be before "end", which is {end:g}'
        )
    translate = _vector(plugin, props, "translate", (0, 0, 0))
    if "axis" not in props:
        return Motion.uniform(begin, end, translate)
    axis = _vector(plugin, props, "axis")
    length = np.linalg.norm(axis)
    if length == 0:
        raise ValueError(f'"{plugin}": the parameter "axis" must not be zero')
    if "angle" not in props:
        raise ValueError(
            f'"{plugin}": the parameter "axis" needs the parameter "angle", in degrees'
        )
    angle = math.radians(read_parameter(plugin, props, "angle", 0.0))
    center = _vector(plugin, props, "center", (0, 0, 0))
    return Motion.uniform(begin, end, translate, axis / length * angle, center)


def _keyed(plugin: str, props: mi.Properties, keys: list[str]) -> Motion:
    count = len(keys) // 2
    wanted = sorted(f"{kind}_{i}" for kind in ("pose", "time") for i in range(count))
    if keys != wanted or count < 2:
        raise ValueError(
            f'"{plugin}": poses are "pose_0", "pose_1" and so on, two at least, each with its '
            f'"time_0", "time_1"; found {", ".join(keys)}'
        )
    times = [read_parameter(plugin, props, f"time_{i}", 0.0) for i in range(count)]
    for i in range(1, count):
        if not times[i - 1] < times[i]:
            raise ValueError(
                f'"{plugin}": "time_{i}" is {times[i]:g} and must be after "time_{i - 1}", which '
                f"is {times[i - 1]:g}"
            )
    return Motion.keyed(times, [_pose(plugin, props, f"pose_{i}") for i in range(count)])


def _pose(plugin: str, props: mi.Properties, key: str) -> np.ndarray:
    value = props[key]
    if not hasattr(value, "matrix"):
        raise TypeError(f'"{plugin}": the parameter "{key}" must be a transform')
    matrix = np.array(value.matrix, dtype=np.float64)
    rotation = matrix[:3, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    is_rotation &= np.linalg.det(rotation) > 0
    if not (is_rotation and np.isfinite(matrix).all() and (matrix[3] == (0, 0, 0, 1)).all()):
        raise ValueError(
            f'"{plugin}": the parameter "{key}" must be rigid, a rotation and a translation: scale '
            f'and mirror what is nested, by its "to_world"'
        )
    return matrix


def _vector(
    plugin: str, props: mi.Properties, key: str, default: tuple[float, ...] | None = None
) -> np.ndarray:
    value = props.get(key, default)
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f'"{plugin}": the parameter "{key}" must be three finite numbers')
    return vector
