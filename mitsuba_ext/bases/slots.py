"""The slots of an integrator: which decisions of the walk a scene can replace, and by what."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi

from ..estimators.light_paths.choice.light_paths import (
    MOST_PATHS,
    AutoLightPaths,
    LightPathCount,
)
from ..estimators.light_paths.subpath_choice.parameters import LearnedSubpaths
from ..planning.technique import ParameterReader, Technique
from ..techniques.guided_directions.parameters import Guided
from ..techniques.guided_directions.roulette_parameters import GuidedRoulette
from ..techniques.learned_lights.parameters import LearnedLights
from ..techniques.linear_lights.parameters import LinearLights
from ..techniques.mis.parameters import HEURISTICS, MisHeuristic
from ..techniques.portal_lights.parameters import PortalLights
from ..techniques.resampled_lights.parameters import ResampledLightsChoice
from ..techniques.shadow_rejection.parameters import RejectedShadowRays
from ..techniques.spatial_lights.parameters import PowerLights, SpatialLights
from ..techniques.swarming.parameters import MAPS
from ..techniques.two_stage_lights.parameters import TwoStageLights
from ..techniques.weighted_points.camera_numbers import PURPOSES, WeightedNumbers
from ..techniques.weighted_points.connections import Connections
from ..util.errors import did_you_mean
from ..util.pointsets import PATTERNS

_Maker = Callable[[ParameterReader], Technique]

#: Ways to choose a light, and what reads the parameters of each; ``None`` for that of ``path``.
METHODS: dict[str, _Maker | None] = {
    "uniform": None,
    "power": lambda read: PowerLights(),
    "spatial": SpatialLights,
    "linear": lambda read: LinearLights(),
    "visibility": lambda read: LearnedLights(read, "visibility"),
    "contribution": lambda read: LearnedLights(read, "contribution"),
}

#: Further ways, for integrators without light paths.
CAMERA_METHODS: dict[str, _Maker] = {
    "resampled": ResampledLightsChoice,
    "two_stage": TwoStageLights,
    "triple_product": lambda read: TwoStageLights(read, "primary"),
    "portals": PortalLights,
}

#: For each slot, the words that a scene can give: the name of a decision, and what makes it with
#: all defaults. ``None`` stands for what Mitsuba's ``path`` does, and comes first. Learners are
#: made in the order of the slots: later ones can use earlier ones.
SLOTS: dict[str, dict[str, _Maker | None]] = {
    "directions": {"uniform": None, "guided": Guided, "swarm": MAPS["directions"]},
    "scattering": {"bsdf": None, "swarm": MAPS["scattering"]},
    "next_event": {**METHODS, **CAMERA_METHODS},
    "light_numbers": {"uniform": None, "swarm": MAPS["light_numbers"]},
    "roulette": {"automatic": lambda read: GuidedRoulette(), "throughput": None},
    "connections": {"one": None},
    "mis": {HEURISTICS[0]: None, **{name: MisHeuristic.named(name) for name in HEURISTICS[1:]}},
    "shadow_test": {"always": None, "visibility_roulette": RejectedShadowRays},
    **{slot: {"sampler": None, "swarm": MAPS[slot]} for slot in (*PURPOSES, "distance")},
}

#: The slots that only bidirectional integrators have. They also have some of :data:`SLOTS`.
BIDIRECTIONAL_SLOTS: dict[str, dict[str, _Maker | None]] = {
    "subpath_selection": {"uniform": None, "visibility": lambda read: LearnedSubpaths()},
    "light_paths": {"always": None, "auto": lambda read: AutoLightPaths()},
}

_ALL_SLOTS = {**SLOTS, **BIDIRECTIONAL_SLOTS}

#: The plugins of this package that can be nested into a slot.
_PLUGINS: tuple[type[Technique], ...] = (
    Guided, LearnedLights, SpatialLights, ResampledLightsChoice, TwoStageLights, PortalLights,
    Connections, MisHeuristic, RejectedShadowRays, WeightedNumbers,
)  # fmt: skip


def read_slot(plugin: str, props: mi.Properties, slot: str) -> Technique | None:
    """Reads what the scene puts into a slot: a word, or a nested plugin; for ``connections`` and
    ``light_paths`` also a number. ``None`` for what ``path`` does.

    Raises:
        TypeError, ValueError: The value is none of these, or belongs into another slot.
    """
    words = _ALL_SLOTS[slot]
    value = props.get(slot, next(iter(words)))
    parameters = getattr(value, "technique", None)
    if parameters is not None:
        parameters.check_slot(plugin, slot)
        return parameters
    if slot == "connections" and type(value) is int:
        return Connections(ParameterReader.of_defaults(plugin, {"count": slot}, count=value))
    if slot == "light_paths" and LightPathCount.accepts(value):
        return LightPathCount(float(value))
    if slot in PURPOSES and isinstance(value, str) and value in PATTERNS:
        parameters = WeightedNumbers(ParameterReader.of_defaults(plugin, pattern=value))
        parameters.check_slot(plugin, slot)
        return parameters
    if not isinstance(value, str) or value not in words:
        raise ValueError(f'"{plugin}": the parameter "{slot}" is {_accepted(slot, value)}')
    maker = words[value]
    if maker is None:
        return None
    parameters = maker(ParameterReader.of_defaults(plugin))
    parameters.check_slot(plugin, slot)
    return parameters


def _accepted(slot: str, value: object) -> str:
    """The end of the error message for a value that a slot does not accept."""
    found = value.class_name() if isinstance(value, mi.Object) else repr(value)
    words = [*_ALL_SLOTS[slot], *(PATTERNS if slot in PURPOSES else ())]
    number = "a number, " if slot == "connections" else ""
    plugins = [f'"{kind.name}"' for kind in _PLUGINS if slot in kind.slots]
    nested = f", {number}or a nested plugin: {' or '.join(plugins)}" if plugins else ""
    if slot == "light_paths":
        nested = f", or a number from 0 to {MOST_PATHS:g}"
    hint = did_you_mean(value, words) if isinstance(value, str) else ""
    if f'"{value}"' in plugins:
        hint = f": nest the plugin (on the command line: {slot}=[{value}])"
    return f"{found}; it must be one of {', '.join(words)}{nested}{hint}"
