"""Which shapes of a scene move, and who does not see it."""

from __future__ import annotations

import mitsuba as mi

from .motion import Motion


def movers(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes of ``scene`` that move: they have a ``motion``, and a scene ``at_rest``."""
    return [s for s in scene.shapes() if isinstance(getattr(s, "motion", None), Motion)]


def refuse_movers(scene: mi.Scene, what: str, instead: str) -> None:
    """For what cannot show moving shapes.

    Parameters:
        what: Begins the sentence: which plugin or parameter does not see them.
        instead: Ends it: what to do.

    Raises:
        NotImplementedError: Something moves in ``scene``.
    """
    if movers(scene):
        raise NotImplementedError(
            f"{what} does not see the moving shapes of this scene: {instead}."
        )


def check_motion_is_seen(integrator: mi.Integrator, scene: mi.Scene) -> None:
    """
    Raises:
        NotImplementedError: Something moves in ``scene``, and the integrator is one of Mitsuba's
            own, which would render it without that.
    """
    if type(integrator).__module__.split(".")[0] == "mitsuba":
        name = f'"{integrator.class_name()}", an integrator of Mitsuba\'s own,'
        refuse_movers(scene, name, 'use "composed_path"')
