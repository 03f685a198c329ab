"""Sample swarming: maps of primary samples that tiles of pixels share, one for each decision."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from ...planning.learner import Learner
from ...planning.technique import (
    ParameterReader,
    Setting,
    Slots,
    Technique,
    check_has_wavelengths,
)
from ...rendering.camera import film_extent
from ...scene.media import has_homogeneous_media
from .camera_map_learner import CameraMapLearner
from .cells import Cells
from .direction_map_learner import DirectionMapLearner
from .light_numbers_learner import LightNumbersLearner
from .lobe_map_learner import LobeMapLearner
from .mapped_lights import LightMaps, light_cells
from .mapped_lobes import MappedLobes, divides
from .mapped_numbers import MappedNumbers
from .mapped_scattering import MappedScattering


class Swarm(Technique):
    """Maps of one decision: the base class.

    Parameters:
        always: Use the maps also where pilots show that they do not pay off? For tests.

    Attributes:
        summary: The name of the maps in the log.
    """

    name = "swarm"
    words = {"swarm": {}}
    doubles = True
    # The learners of all maps together record about 150, in arrays whose sizes are powers of two
    bytes_per_sample = 256
    summary = ""

    def __init__(self, read: ParameterReader, always: bool = False) -> None:
        self._always, self._pilot_spp = always, read.default("pilot_spp", 64)

    @property
    def pilot_spp(self) -> int:
        """See :class:`Technique`."""
        return self._pilot_spp

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and any(map(self.is_asked, scene.sensors()))

    def is_asked(self, sensor: mi.Sensor) -> bool:
        """Whether the sensor uses the numbers of these maps."""
        return True

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        if not self.can_learn(setting.scene, setting.pilot_spp) or not self.is_asked(
            setting.sensor
        ):
            return None
        width, height = film_extent(setting.sensor.film())
        return self.map_learner(setting, width, height)

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        """The learner, for a film of this size."""
        raise NotImplementedError

    def _how(self, setting: Setting) -> dict[str, Any]:
        """The parameters of all learners."""
        return {"samples": setting.pilot_spp, "always": self._always}


class TimeMaps(Swarm):
    """Maps of the time in the shutter interval."""

    finds_all_light = True
    slots, summary = ("time",), "times"

    def is_asked(self, sensor: mi.Sensor) -> bool:
        return sensor.shutter_open_time() > 0

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.line(6))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


class LensMaps(Swarm):
    """Maps of the aperture."""

    finds_all_light = True
    slots, summary = ("aperture",), "lens"

    def is_asked(self, sensor: mi.Sensor) -> bool:
        return sensor.needs_aperture_sample()

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.square(5))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


class WavelengthMaps(Swarm):
    """Maps of the number that chooses wavelengths."""

    finds_all_light = True
    slots, summary = ("wavelength",), "wavelengths"

    def check_slot(self, plugin: str, slot: str) -> None:
        super().check_slot(plugin, slot)
        check_has_wavelengths(plugin)

    def is_asked(self, sensor: mi.Sensor) -> bool:
        return mi.is_spectral

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.line(6), periods=4)
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


class LightMapsChoice(Swarm):
    """Maps of the numbers that choose a light and a point on it."""

    slots, summary = ("light_numbers",), "lights"

    def check_together(self, plugin: str, slots: Slots) -> None:
        lights = slots.get("next_event")
        if lights is not None and lights.pilot_spp:
            raise ValueError(
                f'"{plugin}": the parameter "light_numbers" is "swarm", which needs lights that '
                f'are not learned, and "next_event" is "{lights.name}", which learns them: leave '
                f"one of the two out"
            )

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and bool(scene.emitters())

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        technique = setting.techniques.get("next_event")
        lights = technique.decision(setting) if technique else None
        dimension = lights.choice_dimension if lights else 0
        maps = LightMaps(light_cells(setting.scene, dimension))
        return LightNumbersLearner(self.summary, maps, width, height, **self._how(setting))


class LobeMaps(Swarm):
    """Maps of the number that chooses between reflection and transmission."""

    slots, summary = ("directions",), "lobes"

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and divides(scene.shapes())

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        return LobeMapLearner(self.summary, MappedLobes(), width, height, **self._how(setting))


class DirectionMaps(Swarm):
    """Maps of directions, combined with BSDF sampling."""

    slots, summary = ("scattering",), "directions"

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and bool(scene.emitters())

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        maps = MappedScattering()
        return DirectionMapLearner(self.summary, maps, width, height, **self._how(setting))


class DistanceMaps(Swarm):
    """Maps of the first distance in a homogeneous medium."""

    finds_all_light = True
    slots, summary = ("distance",), "distances"

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and has_homogeneous_media(scene)

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.line(7))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


TECHNIQUES = (
    LensMaps, TimeMaps, WavelengthMaps, DistanceMaps, LightMapsChoice, LobeMaps, DirectionMaps,
)  # fmt: skip
