"""The slots of an integrator: which decisions of the walk a scene can replace, and by what."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import mitsuba as mi

from ..estimators.light_paths.choice import light_paths
from ..estimators.light_paths.manifolds import parameters as manifolds
from ..estimators.light_paths.subpath_choice import parameters as subpath_choice
from ..planning.technique import ParameterReader, Technique
from ..scene.media import refuse_media
from ..techniques.focal_points import parameters as focal_points
from ..techniques.guided_directions import parameters as guided_directions
from ..techniques.learned_lights import parameters as learned_lights
from ..techniques.linear_lights import parameters as linear_lights
from ..techniques.mis import parameters as mis
from ..techniques.portal_lights import parameters as portal_lights
from ..techniques.resampled_lights import parameters as resampled_lights
from ..techniques.shadow_rejection import parameters as shadow_rejection
from ..techniques.spatial_lights import parameters as spatial_lights
from ..techniques.swarming import parameters as swarming
from ..techniques.tree_lights import parameters as tree_lights
from ..techniques.two_stage_lights import parameters as two_stage_lights
from ..techniques.weighted_points import parameters as weighted_points
from ..util.errors import did_you_mean

#: The techniques. Who deletes the folder of one deletes its row here, and its import.
_TECHNIQUES: tuple[type[Technique], ...] = (
    *guided_directions.TECHNIQUES,
    *focal_points.TECHNIQUES,
    *spatial_lights.TECHNIQUES,
    *linear_lights.TECHNIQUES,
    *tree_lights.TECHNIQUES,
    *learned_lights.TECHNIQUES,
    *resampled_lights.TECHNIQUES,
    *two_stage_lights.TECHNIQUES,
    *portal_lights.TECHNIQUES,
    *swarming.TECHNIQUES,
    *weighted_points.TECHNIQUES,
    *mis.TECHNIQUES,
    *shadow_rejection.TECHNIQUES,
    *manifolds.TECHNIQUES,
    *subpath_choice.TECHNIQUES,
    *light_paths.TECHNIQUES,
)

#: The words for the decisions of Mitsuba's ``path``, by slot. Learners are made in the order of the
#: slots: later ones can use earlier ones.
_PATH_WORDS = {
    "directions": "uniform", "scattering": "bsdf", "next_event": "uniform",
    "light_numbers": "uniform", "roulette": "throughput", "flights": "transmittance",
    "connections": "one", "mis": "power", "shadow_test": "always", "caustics": "scattered",
    "aperture": "sampler", "time": "sampler", "wavelength": "sampler", "distance": "sampler",
}  # fmt: skip

#: The same for the slots that only integrators with light paths have.
_LIGHT_PATH_WORDS = {"subpath_selection": "uniform", "light_paths": "always"}

_Maker = Callable[[ParameterReader], Technique]


def _words(slot: str, path_word: str) -> dict[str, _Maker | None]:
    """What makes the technique of each word; the default comes first."""
    chosen = [kind for kind in _TECHNIQUES if slot in kind.slots]
    # The sort is stable
    chosen.sort(key=lambda kind: not kind.is_default)
    words: dict[str, _Maker | None] = {
        word: partial(kind, **arguments)
        for kind in chosen for word, arguments in kind.words.items()
    }  # fmt: skip
    if chosen and chosen[0].is_default:
        return {**words, path_word: None}
    return {path_word: None, **words}


#: For each slot, the words that a scene can give: the name of a decision, and what makes it with
#: all defaults. ``None`` stands for the decision of ``path``. The default comes first.
SLOTS = {slot: _words(slot, word) for slot, word in _PATH_WORDS.items()}

#: The slots that only bidirectional integrators have. They also have some of :data:`SLOTS`.
BIDIRECTIONAL_SLOTS = {slot: _words(slot, word) for slot, word in _LIGHT_PATH_WORDS.items()}

_ALL_SLOTS = {**SLOTS, **BIDIRECTIONAL_SLOTS}

#: The words of the slot ``next_event`` of integrators with light paths too.
LIGHT_CHOICES = {
    word: maker for word, maker in SLOTS["next_event"].items()
    if maker is None or not maker.func.camera_paths_only
}  # fmt: skip

#: What ``auto_path`` and ``auto`` learn for camera paths.
_AUTO = {
    "directions": "guided", "scattering": "focal", "next_event": "contribution",
    "roulette": "automatic", "time": "swarm", "aperture": "swarm", "wavelength": "swarm",
    "distance": "swarm",
}  # fmt: skip

#: The pilot samples per pixel of what ``auto`` learns: maps alone would ask for more.
_AUTO_PILOT_SPP = 32


def read_slot(plugin: str, props: mi.Properties, slot: str) -> Technique | None:
    """Reads what the scene puts into a slot: a word, a nested plugin, or a number where a technique
    takes one. ``None`` for what ``path`` does.

    Raises:
        TypeError, ValueError: The value is none of these, or belongs into another slot.
    """
    words = _ALL_SLOTS[slot]
    value = props.get(slot, next(iter(words)))
    technique = getattr(value, "technique", None)
    for kind in _TECHNIQUES if technique is None else ():
        if slot in kind.slots:
            technique = technique or kind.of_value(plugin, slot, value)
    if technique is None:
        if not isinstance(value, str) or value not in words:
            raise ValueError(f'"{plugin}": the parameter "{slot}" is {_accepted(slot, value)}')
        maker = words[value]
        if maker is None:
            return None
        technique = maker(ParameterReader.of_defaults(plugin))
    technique.check_slot(plugin, slot)
    return technique


def check_together(
    plugin: str, techniques: Mapping[str, Technique], has_light_paths: bool
) -> None:
    """Checks that techniques, by slot, go together.

    Raises:
        TypeError, ValueError: Two exclude each other, or one excludes light paths.
    """
    for slot, technique in techniques.items():
        technique.check_together(plugin, techniques)
        if has_light_paths and technique.camera_paths_only:
            raise ValueError(
                f'"{plugin}": the parameter "{slot}" is "{technique.name}", which is for '
                f"integrators without light paths"
            )


def refuse_media_in_slots(
    plugin: str, techniques: Mapping[str, Technique], scene: mi.Scene
) -> None:
    """
    Raises:
        NotImplementedError: A technique does not support the participating media of ``scene``.
    """
    for slot, technique in techniques.items():
        if not technique.sees_media:
            what = f'"{plugin}": the parameter "{slot}" is "{technique.name}", which'
            default = next(iter(_ALL_SLOTS[slot]))
            refuse_media(scene, what, f'choose another one, such as "{default}"')


def auto_techniques(plugin: str) -> dict[str, Technique]:
    """All that ``auto_path`` tries, by slot."""
    read = ParameterReader.of_defaults(plugin, pilot_spp=_AUTO_PILOT_SPP)
    return {slot: SLOTS[slot][word](read) for slot, word in _AUTO.items() if word in SLOTS[slot]}


def _accepted(slot: str, value: object) -> str:
    """The end of the error message for a value that a slot does not accept."""
    found = value.class_name() if isinstance(value, mi.Object) else repr(value)
    words = list(_ALL_SLOTS[slot])
    kinds = [kind for kind in _TECHNIQUES if slot in kind.slots]
    plugins = [f'"{kind.name}"' for kind in kinds if kind.is_plugin]
    others = [kind.values for kind in kinds if kind.values]
    if plugins:
        others.append(f"a nested plugin: {' or '.join(plugins)}")
    more = "".join(f", {other}" for other in others[:-1])
    more += f", or {others[-1]}" if others else ""
    hint = did_you_mean(value, words) if isinstance(value, str) else ""
    if f'"{value}"' in plugins:
        hint = f": nest the plugin (on the command line: {slot}=[{value}])"
    return f"{found}; it must be one of {', '.join(words)}{more}{hint}"
