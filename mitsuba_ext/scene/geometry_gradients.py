"""Which gradients are requested."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr

#: Parameters of shapes and sensors that move what rays hit.
_GEOMETRY = ("vertex_positions", "vertex_normals", "to_world", "x_fov", "principal_point_offset_x",
             "principal_point_offset_y")  # fmt: skip


def refuse_geometry(plugin: str, params: Any) -> None:
    """
    Parameters:
        plugin: Name of the integrator.
        params: The parameters that ``mi.render`` was given, such as those of ``mi.traverse``.

    Raises:
        NotImplementedError: Gradients with respect to the place of something are requested.
    """
    if not (isinstance(params, Mapping) or hasattr(params, "items")):
        return
    for key, value in params.items():
        if str(key).rpartition(".")[2] in _GEOMETRY and dr.grad_enabled(value):
            raise NotImplementedError(
                f'"{plugin}": there are no gradients with respect to "{key}", which moves things; '
                f'use "prb" or "prb_projective"'
            )
