"""Which shapes of a scene move, and errors where an integrator does not see that."""

from __future__ import annotations

import mitsuba as mi

from .motion import Motion
from .nesting import class_name


def movers(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes of ``scene`` that move: they have a ``motion``, and a scene ``at_rest``."""
    return [s for s in scene.shapes() if isinstance(getattr(s, "motion", None), Motion)]


def refuse_movers(scene: mi.Scene, what: str, instead: str) -> None:
    """Raises an error if something moves in ``scene``.

    Parameters:
        what: Begins the message: the plugin or the parameter that does not see moving shapes.
        instead: Ends the message: what to do.

    Raises:
        NotImplementedError: Something moves in ``scene``.
    """
    if movers(scene):
        raise NotImplementedError(
            f"{what} does not see the moving shapes of this scene: {instead}."
        )


def check_motion_is_seen(integrator: mi.Integrator, scene: mi.Scene) -> None:
    """Refuses to render a scene in which something moves with an integrator that does not see it.

    Those that see it say so by the attribute ``sees_motion``. Mitsuba's own integrators and those
    of other packages would render the scene without the shapes that move.

    Raises:
        NotImplementedError: Something moves in ``scene``, and the integrator does not see it.
    """
    if not getattr(integrator, "sees_motion", False):
        refuse_movers(scene, f'"{class_name(integrator)}"', 'use "composed_path"')
