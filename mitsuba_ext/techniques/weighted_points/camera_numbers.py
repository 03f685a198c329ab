"""The slots ``aperture``, ``time`` and ``wavelength``: what generates the primary samples that
choose these of a camera ray."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ...planning.technique import ParameterReader, Setting, Technique, check_has_wavelengths
from ...util.pointsets import PATTERNS
from .pixel_sets import PixelSets
from .weighted_sets import WEIGHTS, WeightedSets

#: The most points of a set, without and with a timeout.
_MOST_POINTS, _MOST_POINTS_TIMED = 1024, 64


@dataclass(frozen=True)
class Purpose:
    """What the numbers of a point set choose.

    Attributes:
        index: Part of the seed, so that each purpose has sets of its own.
        dimension: Dimension of the sets.
        periods: See :class:`WeightedSets`.
        weights: The values of the parameter ``weights`` that are accepted.
    """

    index: int
    dimension: int = 1
    periods: int = 1
    weights: tuple[str, ...] = WEIGHTS


PURPOSES = {
    "aperture": Purpose(0, dimension=2),
    "time": Purpose(1),
    "wavelength": Purpose(2, periods=4, weights=("none", "voronoi", "torus")),
}


class WeightedNumbers(Technique):
    """Numbers from weighted point sets. The attributes are the parameters of the plugin
    ``weighted_numbers``; see there.

    Raises:
        TypeError, ValueError: A parameter has a wrong type or value.
    """

    name, is_plugin = "weighted_numbers", True
    slots = tuple(PURPOSES)
    words = {pattern: {"pattern": pattern} for pattern in PATTERNS}

    def __init__(
        self, read: ParameterReader, accepted: tuple[str, ...] = WEIGHTS, pattern: str = ""
    ) -> None:
        self.pattern = pattern or read("pattern", "lattice", choices=PATTERNS)
        self.weights = read("weights", "none", choices=accepted)

    def check_slot(self, plugin: str, slot: str) -> None:
        super().check_slot(plugin, slot)
        accepted = PURPOSES[slot].weights
        if self.weights not in accepted:
            raise ValueError(
                f'"{plugin}": the parameter "{slot}" has weights = {self.weights}; it must be one '
                f"of {', '.join(accepted)}"
            )
        if slot == "wavelength":
            check_has_wavelengths(plugin)

    needs_equal_samples = 'the sets of numbers of "{slot}" belong together: leave the parameter out'

    def samples_per_set(self, spp: int) -> int:
        return samples_per_set(spp, is_timed=True)

    def decision(self, setting: Setting) -> PixelSets | None:
        """The numbers of a render; ``None``, with a warning, if the image does not depend on them.
        """
        reason = _reason_to_do_nothing(setting.slot, setting.sensor)
        if reason is not None:
            mi.Log(mi.LogLevel.Warn, f'"{setting.plugin}" reweights nothing: {reason}')
            return None
        purpose = PURPOSES[setting.slot]
        seeds = [setting.seed, purpose.index]
        count = samples_per_set(setting.spp, setting.is_timed)
        sets = WeightedSets(
            self.pattern, self.weights, count, purpose.dimension, seeds, purpose.periods
        )
        return PixelSets(sets, seeds)


def samples_per_set(spp: int, is_timed: bool) -> int:
    """The number of points of a set: each sample of a pixel uses one."""
    most = _MOST_POINTS_TIMED if is_timed else _MOST_POINTS
    return -(-spp // -(-spp // most))


def _reason_to_do_nothing(slot: str, sensor: mi.Sensor) -> str | None:
    """Why the image does not depend on the numbers, and what to change; ``None`` if it does."""
    if slot == "aperture" and not sensor.needs_aperture_sample():
        return 'the sensor has no aperture; use a "thinlens".'
    if slot == "time" and sensor.shutter_open_time() <= 0:
        return "the sensor's shutter does not stay open; set shutter_open and shutter_close."
    return None
