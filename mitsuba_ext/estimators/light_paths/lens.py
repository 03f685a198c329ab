"""The parameter ``lens_sampling``: how a light path chooses a point of the aperture."""

from __future__ import annotations

import mitsuba as mi

from ...scene.movers import sensor_at_rest
from ...transport.path_decisions import SceneQuery
from .lens_visibility import visibility_lens
from .parallel_sensor import ParallelSensor
from .sensor import ConnectableSensor

#: The values of the parameter.
LENS_SAMPLING = ("uniform", "visibility")


def connectable(sensor: mi.Sensor) -> ConnectableSensor:
    """A sensor for which :meth:`ConnectableSensor.can_connect` is true, as an end of
    connections."""
    is_parallel = sensor_at_rest(sensor).class_name() == "OrthographicCamera"
    return (ParallelSensor if is_parallel else ConnectableSensor)(sensor)


def connectable_sensor(
    plugin: str, lens_sampling: str, scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery
) -> ConnectableSensor:
    """The sensor of a render, to which light paths are connected.

    Parameters:
        plugin: The plugin's name in warnings.
        lens_sampling: One of ``LENS_SAMPLING``.
    """
    if lens_sampling == "uniform":
        return connectable(sensor)
    if not sensor.needs_aperture_sample():
        mi.Log(
            mi.LogLevel.Warn,
            f'"{plugin}": the parameter "lens_sampling" has no effect: the sensor '
            f'"{sensor.class_name()}" has no aperture.',
        )
        return connectable(sensor)
    return ConnectableSensor(sensor, visibility_lens(scene, sensor, query))
