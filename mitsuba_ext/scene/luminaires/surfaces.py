"""Chooses the sampling method for each kind of shape."""

from __future__ import annotations

import mitsuba as mi

from .disk import DiskSurface, is_round
from .mesh import MAX_TRIANGLES, MeshSurface, triangle_count
from .rectangle import ProjectedRectangleSurface, RectangleSurface
from .sphere import SphereSurface
from .surface import Surface


def surface(name: str, shape: mi.Shape | None, is_projected: bool = False) -> Surface:
    """The sampling method for a light on this shape.

    Parameters:
        name: Name of the light's plugin, for errors.
        shape: The shape of the light.
        is_projected: Whether to sample by projected solid angle.

    Raises:
        NotImplementedError: Shapes of this kind cannot be sampled by (projected) solid angle.
        RuntimeError: The light has no shape.
    """
    if shape is None:
        raise RuntimeError(f'"{name}": the light needs a shape: put it in one')
    kind = mi.ShapeType(int(shape.shape_type()))
    if kind == mi.ShapeType.Rectangle:
        return (ProjectedRectangleSurface if is_projected else RectangleSurface)(shape)
    if is_projected:
        raise NotImplementedError(
            f'"{name}": sampling "projected" needs a rectangle, found "{shape.class_name()}"; use '
            f'"solid_angle"'
        )
    if kind == mi.ShapeType.Sphere:
        return SphereSurface(shape)
    if kind == mi.ShapeType.Disk:
        return DiskSurface(shape) if is_round(shape) else Surface(shape)
    if kind == mi.ShapeType.Mesh:
        is_small = triangle_count(shape) <= MAX_TRIANGLES
        return MeshSurface(shape) if is_small else Surface(shape)
    raise NotImplementedError(
        f'"{name}": cannot sample the solid angle of a shape "{shape.class_name()}"; give the '
        f'light to a rectangle, disk, sphere or mesh, or use the emitter "area"'
    )
