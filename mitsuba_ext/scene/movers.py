"""What of a scene moves, and errors where an integrator does not see that."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..motion.rigid_motion import Motion
from .nesting import class_name


def movers(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes of ``scene`` that move: they have a ``motion``, and a scene ``at_rest``."""
    return [s for s in scene.shapes() if isinstance(getattr(s, "motion", None), Motion)]


def is_moving_light(emitter: mi.Emitter) -> bool:
    """Is it a light that moves? It has a ``nested`` emitter, which rests, and a ``motion``."""
    return isinstance(getattr(emitter, "motion", None), Motion)


def is_moving_camera(sensor: mi.Sensor) -> bool:
    """Is it a ``moving_camera``? It has a ``nested`` sensor, a ``motion`` and ``poses``."""
    return isinstance(getattr(sensor, "motion", None), Motion)


def sensor_at_rest(sensor: mi.Sensor) -> mi.Sensor:
    """The sensor that is nested in a ``moving_camera``; any other sensor itself."""
    return sensor.nested if is_moving_camera(sensor) else sensor


def point_at_rest(sensor: mi.Sensor, p: mi.Point3f, time: mi.Float) -> mi.Point3f:
    """Where :func:`sensor_at_rest` has what ``sensor`` has at ``p`` at a time."""
    if not is_moving_camera(sensor):
        return p
    return sensor.poses.pose(mi.UInt32(0), time).point_to_rest(p)


def viewing_axis(sensor: mi.Sensor, time: mi.Float) -> mi.Vector3f:
    """The unit vector in which a sensor looks at a time."""
    to_world = mi.Transform4f(sensor_at_rest(sensor).world_transform())
    axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
    if not is_moving_camera(sensor):
        return axis
    return sensor.poses.pose(mi.UInt32(0), time).rotation @ axis


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


def refuse_moving_lights(scene: mi.Scene) -> None:
    """Raises an error if a light moves: for what starts paths from lights.

    Raises:
        NotImplementedError: A light of ``scene`` moves.
    """
    if any(map(is_moving_light, scene.emitters())):
        raise NotImplementedError(
            'paths cannot start from lights that move: use an integrator without light paths, such '
            'as "composed_path"'
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
