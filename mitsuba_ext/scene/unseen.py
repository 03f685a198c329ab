"""Refuses to render scenes with shapes that only the integrators of this package see."""

from __future__ import annotations

import mitsuba as mi

from .lightweight_shapes import lightweight_shapes
from .movers import movers, refuse_movers
from .nesting import class_name


def has_unseen_shapes(scene: mi.Scene) -> bool:
    """Whether ``scene`` has shapes that Mitsuba's own integrators do not see."""
    return bool(movers(scene) or lightweight_shapes(scene))


def check_all_is_seen(integrator: mi.Integrator, scene: mi.Scene) -> None:
    """Refuses to render a scene with shapes that the integrator does not see.

    Integrators that see them have the attribute ``sees_all``. Integrators of Mitsuba and of other
    packages would render the scene without moving and lightweight shapes.

    Raises:
        NotImplementedError: The integrator does not see a shape in ``scene``.
    """
    if getattr(integrator, "sees_all", False):
        return
    name = f'"{class_name(integrator)}"'
    refuse_movers(scene, name, 'use "composed_path"')
    if lightweight := lightweight_shapes(scene):
        raise NotImplementedError(
            f'{name} does not see the shape "{lightweight[0].name}" of this scene: use '
            f'"composed_path".'
        )
