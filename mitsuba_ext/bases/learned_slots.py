"""What ``auto_path`` and ``auto`` learn for camera paths."""

from __future__ import annotations

from ..planning.technique import ParameterReader, Technique
from ..techniques.guided_directions.parameters import Guided
from ..techniques.guided_directions.roulette_parameters import GuidedRoulette
from ..techniques.learned_lights.parameters import LearnedLights
from ..techniques.swarming.parameters import MAPS

#: The random numbers of a camera ray that can have learned maps.
CAMERA_NUMBERS = ("time", "aperture", "wavelength", "distance")


def learned_slots(plugin: str) -> dict[str, Technique]:
    """All that is tried, by slot, with its defaults."""
    read = ParameterReader.of_defaults(plugin)
    return {
        "directions": Guided(read),
        "next_event": LearnedLights(read),
        "roulette": GuidedRoulette(),
        # Maps alone would ask for more pilot samples than guided directions
        **{slot: MAPS[slot](read, pilot_spp=Guided.pilot_spp) for slot in CAMERA_NUMBERS},
    }
