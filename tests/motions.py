"""Rigid motions: as parameters of ``moving``, and as poses that are computed here."""

from __future__ import annotations

from typing import Any, Callable

import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

Scene = dict[str, Any]

#: The matrix of a time.
Pose = Callable[[float], np.ndarray]


def uniform(translate, axis, angle, center, begin=0.0, end=1.0) -> tuple[Scene, Pose]:
    def pose(time: float) -> np.ndarray:
        x = np.clip((time - begin) / (end - begin), 0, 1)
        unit = np.array(axis) / np.linalg.norm(axis)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(unit * np.radians(x * angle)).as_matrix()
        matrix[:3, 3] = x * np.array(translate) + center - matrix[:3, :3] @ center
        return matrix

    parameters = {"translate": translate, "axis": axis, "angle": angle, "center": center,
                  "begin": begin, "end": end}  # fmt: skip
    return parameters, pose


def keyed(times, rotations: Rotation, positions) -> tuple[Scene, Pose]:
    slerp, positions = Slerp(times, rotations), np.array(positions)

    def pose(time: float) -> np.ndarray:
        time = np.clip(time, times[0], times[-1])
        matrix = np.eye(4)
        matrix[:3, :3] = slerp(time).as_matrix()
        matrix[:3, 3] = [np.interp(time, times, column) for column in positions.T]
        return matrix

    parameters: Scene = {}
    for i, time in enumerate(times):
        parameters[f"time_{i}"] = float(time)
        parameters[f"pose_{i}"] = mi.ScalarTransform4f(pose(time))
    return parameters, pose
