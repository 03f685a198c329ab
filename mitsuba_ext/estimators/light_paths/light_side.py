"""What light paths need to know about a scene."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ...rendering.camera import check_takes_splats
from ...transport.light_table import sampling_weights
from ...transport.path_decisions import EmitterSampling
from .both_ends import FromBothEnds
from .emission import LightEmission
from .lens import connectable
from .sensor import ConnectableSensor


def light_emission(plugin: str, scene: mi.Scene) -> LightEmission:
    """What emits light paths.

    Raises:
        NotImplementedError: A light cannot emit light paths; the message names the plugin.
    """
    try:
        return LightEmission(scene)
    except NotImplementedError as error:
        raise NotImplementedError(f'"{plugin}": {error}') from None


@dataclass
class LightSide:
    """What bidirectional methods need at the light end of paths.

    Attributes:
        emission: Samples the emitted rays with which light paths begin.
        sensor: The sensor to which light paths are connected; ``None`` if they are not connected
            to it.
        correct: The light sampling of camera paths that replaces Mitsuba's, whose density of
            points is wrong on meshes with interpolated normals; ``None`` in scenes without such
            lights.
    """

    emission: LightEmission
    sensor: ConnectableSensor | None
    correct: EmitterSampling | None

    @classmethod
    def of(
        cls, plugin: str, scene: mi.Scene, sensor: mi.Sensor, has_image: bool = True
    ) -> LightSide:
        """The light side of a scene that has lights.

        Parameters:
            plugin: The plugin's name in error messages.
            has_image: Whether light paths are connected to the sensor, if it and its film allow
                that.

        Raises:
            NotImplementedError: A light cannot emit light paths.
        """
        emission = light_emission(plugin, scene)
        target = connectable(sensor) if has_image and _can_connect(sensor) else None
        correct = sampling_weights(scene) if emission.has_smooth_meshes else None
        return cls(emission, target, correct)

    def next_event(self, chosen: EmitterSampling | None) -> EmitterSampling | None:
        """The decision by which camera paths choose lights in integrators with light paths;
        ``None`` for Mitsuba's choice. ``chosen`` is the decision that the scene asks for."""
        return self.correct if chosen is None else FromBothEnds(chosen)


def _can_connect(sensor: mi.Sensor) -> bool:
    if not ConnectableSensor.can_connect(sensor):
        return False
    try:
        check_takes_splats(sensor.film())
    except NotImplementedError:
        return False
    return True
