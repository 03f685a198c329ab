"""Sample swarming: maps of primary samples that tiles of pixels share, one for each decision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ...planning.decision_parameters import DecisionParameters, ParameterReader, Setting, Slots
from ...planning.learner import Learner
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

#: The largest relative rise of variance, by unequal weights of samples, where no map helps.
_MOST_LOSS = 0.015

#: Where maps help, a sample that is drawn from a map of n samples per pixel is worth about
#: (n + _UNIFORM) / (n + _HALF) of one that is drawn from a perfect map.
_UNIFORM, _HALF = 0.1, 1.5


#: The first sample of all pixels is divided into stages until the first of them takes no more than
#: this share of all samples, as these are drawn from uniform numbers. It has at least this number
#: of pixels: Dr.Jit's tracing of a stage takes as long as the paths of as many.
_FIRST_SHARE, _LEAST_PIXELS = 1 / 32, 1 << 13


class Swarm(DecisionParameters):
    """Maps of one decision: the base class.

    Parameters:
        always: Use the maps also where pilots show that they do not pay off? For tests.
        pilot_spp: Samples per pixel of the pilots.

    Attributes:
        summary: The name of the maps in the log.
    """

    name = "swarm"
    doubles = True
    summary = ""

    def __init__(self, read: ParameterReader, always: bool = False, pilot_spp: int = 64) -> None:
        self._always, self._pilot_spp = always, pilot_spp

    @property
    def pilot_spp(self) -> int:
        """See :class:`DecisionParameters`."""
        return self._pilot_spp

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and any(map(self.is_asked, scene.sensors()))

    def is_asked(self, sensor: mi.Sensor) -> bool:
        """Does the sensor use the numbers of these maps?"""
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

    slots, summary = ("time",), "times"

    def is_asked(self, sensor: mi.Sensor) -> bool:
        return sensor.shutter_open_time() > 0

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.line(6))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


class LensMaps(Swarm):
    """Maps of the aperture."""

    slots, summary = ("aperture",), "lens"

    def is_asked(self, sensor: mi.Sensor) -> bool:
        return sensor.needs_aperture_sample()

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.square(5))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


class WavelengthMaps(Swarm):
    """Maps of the number that chooses wavelengths."""

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

    _lights: DecisionParameters | None = None

    def check_together(self, plugin: str, slots: Slots) -> None:
        lights = slots.get("next_event")
        if lights is not None and lights.pilot_spp:
            raise ValueError(
                f'"{plugin}": the parameter "light_numbers" is "swarm", which needs lights that '
                f'are not learned, and "next_event" is "{lights.name}", which learns them: leave '
                f"one of the two out"
            )
        self._lights = lights

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and bool(scene.emitters())

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        lights = self._lights.decision(setting) if self._lights else None
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

    slots, summary = ("distance",), "distances"

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        return spp > 0 and has_homogeneous_media(scene)

    def map_learner(self, setting: Setting, width: int, height: int) -> Learner:
        numbers = MappedNumbers(Cells.line(7))
        return CameraMapLearner(self.summary, numbers, width, height, **self._how(setting))


#: The maps that each slot can hold.
MAPS: dict[str, type[Swarm]] = {
    "aperture": LensMaps, "time": TimeMaps, "wavelength": WavelengthMaps, "distance": DistanceMaps,
    "light_numbers": LightMapsChoice, "directions": LobeMaps, "scattering": DirectionMaps,
}  # fmt: skip


def check_has_wavelengths(plugin: str) -> None:
    """
    Raises:
        RuntimeError: The variant has no wavelengths.
    """
    if not mi.is_spectral:
        raise RuntimeError(
            f'"{plugin}": the parameter "wavelength" does not work in the variant '
            f'"{mi.variant()}", which has no wavelengths: use a spectral one, such as '
            f'"llvm_ad_spectral".'
        )


def doubling_pilots(samples: int) -> list[int]:
    """The samples per pixel of each pilot: one, and then as many as in all pilots before it."""
    pilots = [1]
    while 2 * sum(pilots) <= samples:
        pilots.append(sum(pilots))
    pilots[-1] += samples - sum(pilots)
    return pilots


def first_parts(pixel_count: int, spp: int) -> int:
    """Into how many stages the first of ``spp`` samples of all pixels is divided."""
    parts = 1
    while 0.5 ** (parts - 1) > _FIRST_SHARE * spp and pixel_count >> parts >= _LEAST_PIXELS:
        parts += 1
    return parts


def stage_weights(stages: Sequence[int], parts: int = 1) -> list[float]:
    """For each stage, the weight of its samples relative to those of the last stage. Where maps
    help much, equal weights would leave most of the noise to samples of the first stages. Where
    maps do not help, unequal weights raise the variance by 1.5 % at most, which limits them.

    Parameters:
        stages: Samples per pixel of each stage.
        parts: Into how many stages the first one is divided.
    """
    count = len(stages) + parts - 1
    # The share of the pixels in each part of the first stage
    shares = [0.5 ** (parts - max(part, 1)) for part in range(parts)] if parts > 1 else [1.0]
    known = np.cumsum([0.0, *(stages[0] * share for share in shares), *stages[1:]])[:count]
    wanted = (known + _UNIFORM) / (known + _HALF)
    wanted = list(wanted / wanted[-1])

    def weights(share: float) -> list[float]:
        return [1 - share * (1 - weight) for weight in wanted]

    def loss_of_pixel(first: float, others: Sequence[float]) -> float:
        pairs = [(stages[0], first), *zip(stages[1:], others)]
        mean = sum(n * w for n, w in pairs)
        return sum(stages) * sum(n * w * w for n, w in pairs) / mean**2 - 1

    def loss(share: float) -> float:
        every = weights(share)
        return sum(s * loss_of_pixel(every[k], every[parts:]) for k, s in enumerate(shares))

    low, high = 0.0, 1.0
    if loss(high) <= _MOST_LOSS:
        return weights(high)
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if loss(middle) <= _MOST_LOSS else (low, middle)
    return weights(low)
