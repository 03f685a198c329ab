"""Finds the moving parts of a scene, and raises errors for features that do not support motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import drjit as dr
import mitsuba as mi

from .motion.rigid_motion import Motion


def movers(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes of ``scene`` that move. They have the attributes ``motion`` and ``at_rest`` (a
    scene)."""
    return [s for s in scene.shapes() if isinstance(getattr(s, "motion", None), Motion)]


def all_shapes(shapes: Iterable[mi.Shape]) -> Iterator[mi.Shape]:
    """The shapes, followed by the shapes inside moving ones."""
    for shape in shapes:
        yield shape
        yield from all_shapes(getattr(shape, "children", ()))


def is_moving_light(emitter: mi.Emitter) -> bool:
    """Whether the emitter is a moving light, with a ``nested`` emitter and a ``motion``."""
    return isinstance(getattr(emitter, "motion", None), Motion)


def is_moving_camera(sensor: mi.Sensor) -> bool:
    """Whether it is a ``moving_camera``, with a ``nested`` sensor, a ``motion`` and ``poses``."""
    return isinstance(getattr(sensor, "motion", None), Motion)


def sensor_at_rest(sensor: mi.Sensor) -> mi.Sensor:
    """The sensor that is nested in a ``moving_camera``; any other sensor is returned as it is."""
    return sensor.nested if is_moving_camera(sensor) else sensor


def point_at_rest(sensor: mi.Sensor, p: mi.Point3f, time: mi.Float) -> mi.Point3f:
    """Transforms a point from world space at ``time`` to the space of :func:`sensor_at_rest`."""
    if not is_moving_camera(sensor):
        return p
    return sensor.poses.pose(mi.UInt32(0), time).point_to_rest(p)


def viewing_axis(sensor: mi.Sensor, time: mi.Float) -> mi.Vector3f:
    """The unit vector along which a sensor looks at a time."""
    to_world = mi.Transform4f(sensor_at_rest(sensor).world_transform())
    axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
    if not is_moving_camera(sensor):
        return axis
    return sensor.poses.pose(mi.UInt32(0), time).rotation @ axis


def refuse_movers(scene: mi.Scene, what: str, instead: str) -> None:
    """Raises an error if something moves in ``scene``.

    Parameters:
        what: The beginning of the message: the plugin or parameter that does not support motion.
        instead: The end of the message, which says what to do.

    Raises:
        NotImplementedError: Something moves in ``scene``.
    """
    if movers(scene):
        raise NotImplementedError(
            f"{what} does not see the moving shapes of this scene: {instead}."
        )


def refuse_to_share(scene: mi.Scene, plugin: str, why: str) -> None:
    """Raises an error where paths have wavelengths or times of their own.

    Parameters:
        why: What the plugin cannot share between such paths, and which plugins to use instead.

    Raises:
        NotImplementedError: The variant is spectral, or something moves in ``scene``.
    """
    reason = "the variant is spectral" if mi.is_spectral else "shapes or lights move"
    if mi.is_spectral or movers(scene):
        raise NotImplementedError(f'"{plugin}": {reason}: {why}')


def refuse_moving_lights(scene: mi.Scene) -> None:
    """Raises an error if a light moves; for methods that start paths from lights.

    Raises:
        NotImplementedError: A light of ``scene`` moves.
    """
    if any(map(is_moving_light, scene.emitters())):
        raise NotImplementedError(
            'paths cannot start from lights that move: use an integrator without light paths, such '
            'as "composed_path"'
        )
