"""Renders the auxiliary images of a denoiser, for scenes with or without moving shapes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..transport.queries.scene import scene_query
from . import guides


def render_guides(scene: mi.Scene, sensor: mi.Sensor, seed: int = 0) -> dict[str, np.ndarray]:
    """Renders the albedo and the shading normal of what the camera sees, in mirrors and through
    glass too. Replaces the contents of the film.

    Returns:
        Arrays [height, width] by channel name: ``albedo.R``, …, ``normal.Z``.
    """
    return guides.render_guides(scene, sensor, scene_query(scene), seed)
