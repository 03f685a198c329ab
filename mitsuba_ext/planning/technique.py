"""The base class of techniques: the parameters of a decision, as the scene gives them, and the
decision or learner that they make for one render."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import mitsuba as mi

from ..rendering.camera import film_extent
from ..transport.decisions import CAMERA_SLOTS, Decisions
from ..util.parameters import read_parameter
from .learner import Learner


@dataclass(frozen=True)
class Setting:
    """The render for which a decision is made.

    Attributes:
        scene, sensor: What is rendered.
        seed: The seed of the render.
        max_depth, rr_depth: Longest path in segments, and depth at which roulette begins.
        spp: Samples per pixel of the render.
        pilot_spp: How many of these are pilot samples.
        is_timed: Whether a timeout can end the render before it has all samples.
        plugin: The integrator's name in errors and warnings.
        slot: The slot for which a decision is made.
        techniques: What fills the slots of the integrator.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: int
    max_depth: int
    rr_depth: int
    spp: int
    pilot_spp: int = 0
    is_timed: bool = False
    plugin: str = ""
    slot: str = ""
    techniques: Slots = field(default_factory=dict)

    @property
    def pixel_count(self) -> int:
        """Sampled pixels of the film."""
        width, height = film_extent(self.sensor.film())
        return width * height

    @property
    def pilot_samples(self) -> int:
        """Samples of all pilots together."""
        return self.pixel_count * self.pilot_spp


class ParameterReader:
    """Reads the parameters of a technique from the parameters of a plugin.

    Parameters:
        plugin: The plugin's name in error messages.
        props: The parameters that the scene gives.
        names: The plugin's name of a parameter, by the decision's name, where they differ.
        defaults: The plugin's own defaults.
    """

    def __init__(
        self,
        plugin: str,
        props: mi.Properties,
        names: Mapping[str, str] | None = None,
        **defaults: Any,
    ) -> None:
        self.plugin, self._props = plugin, props
        self._names, self._defaults = names or {}, defaults

    def __call__(self, key: str, default: Any, **accepted: Any) -> Any:
        """Reads and checks a parameter: see :func:`mitsuba_ext.util.parameters.read_parameter`."""
        name = self._names.get(key, key)
        default = self._defaults.get(key, default)
        return read_parameter(self.plugin, self._props, name, default, **accepted)

    def optional_count(self, key: str, maximum: int) -> int:
        """A whole number from 1 to ``maximum``; 0 if the scene does not give it."""
        return self(key, 1, minimum=1, maximum=maximum) if self.is_given(key) else 0

    @classmethod
    def of_defaults(
        cls, plugin: str, names: Mapping[str, str] | None = None, **defaults: Any
    ) -> ParameterReader:
        """A reader without parameters of the scene: it returns the defaults."""
        return cls(plugin, mi.Properties(plugin), names, **defaults)

    def default(self, key: str, default: Any) -> Any:
        """The plugin's default of a parameter that the scene cannot give here."""
        return self._defaults.get(key, default)

    def is_given(self, key: str) -> bool:
        """Whether the scene gives this parameter."""
        return self._names.get(key, key) in self._props

    def refuse_without_effect(self, conditions: Mapping[str, str]) -> None:
        """Refuses parameters that the plugin has not read until now.

        Parameters:
            conditions: What each parameter needs to have an effect, by name.

        Raises:
            ValueError: The scene gives such a parameter.
        """
        for key, condition in conditions.items():
            if key in self._props and not self._props.was_queried(key):
                raise ValueError(
                    f'"{self.plugin}": the parameter "{key}" needs {condition}; leave it out'
                )


#: What fills the slots of an integrator.
Slots = Mapping[str, "Technique"]


class Technique:
    """The parameters of something that can replace one decision of the walk. One object serves all
    renders: it holds no state of any of them.

    Attributes:
        name: Its name in scenes.
        slots: The slots of an integrator that it can fill.
        words: The words by which a scene chooses it, and the further arguments of its constructor
            for each.
        values: What else than a word it is chosen by, for error messages
            (:meth:`of_value`).
        is_default: Whether it is the default of its slots.
        is_plugin: Whether a plugin of its name can be nested in its slots.
        pilot_spp: Pilot samples per pixel from which it learns, by default; 0 if it does not learn.
        pilot_paths: How many samples of the whole film are enough to learn from; 0 if more are
            always better.
        doubles: Whether it can learn from one sample per pixel. Each pilot then has as many samples
            as all before it, and its samples weigh less, the less was known.
        tries: Whether what it learns in a first pilot makes the next ones better.
        bytes_per_sample: Bytes that it records for each sample of a pass from which it learns; 0 if
            the memory of its records has a limit.
        camera_paths_only: Whether it needs what only camera paths store at a vertex (from where it
            is seen, its depth, the density with which BSDF sampling finds a light).
        finds_all_light: Whether it is for camera paths that find all light alone: beside light
            paths, it is left out.
        sees_media: Whether it can decide at vertices in participating media. False if it needs a
            normal or a BSDF.
        tells_visibility: Whether it learns which lights a vertex sees, so that a shadow test can
            use that (:meth:`~mitsuba_ext.planning.learner.Learner.shadow_test`).
        sample_cost: The approximate time of a sample in units of the time of a path.
        sample_bytes: Bytes that it stores for each sample of a pass, about; 0 if no more than a
            path.
        needs_equal_samples: Why all pixels must get the same number of samples, as the end of an
            error message with ``{slot}``; empty if they need not.
    """

    name = ""
    slots: tuple[str, ...] = ()
    words: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
    values = ""
    is_default = is_plugin = False
    pilot_spp = 0
    pilot_paths = 0
    doubles = False
    tries = False
    bytes_per_sample = 0
    camera_paths_only = False
    finds_all_light = False
    sees_media = True
    tells_visibility = False
    sample_cost = 1
    sample_bytes = 0
    needs_equal_samples = ""

    def __init__(self, read: ParameterReader | None = None) -> None:
        """Reads the parameters; by default, there are none."""

    @classmethod
    def of_value(cls, plugin: str, slot: str, value: Any) -> Technique | None:
        """The technique for a number or the like; ``None`` if it does not take this value."""
        return None

    def check_slot(self, plugin: str, slot: str) -> None:
        """
        Raises:
            ValueError: It cannot fill this slot of the plugin with these parameters.
        """
        if slot not in self.slots:
            raise ValueError(
                f'"{plugin}": the parameter "{slot}" cannot be "{self.name}", which is for '
                f"{', '.join(self.slots)}"
            )

    def check_together(self, plugin: str, slots: Slots) -> None:
        """
        Raises:
            ValueError: One of these parameters has no effect with what fills the other slots.
        """

    def can_learn(self, scene: mi.Scene, spp: int) -> bool:
        """Whether ``spp`` pilot samples per pixel can learn something in ``scene``."""
        return False

    def samples_per_set(self, spp: int) -> int:
        """How many of the ``spp`` samples of a pixel a timeout must not separate."""
        return 1

    def decision(self, setting: Setting) -> Any | None:
        """The decision without learning; ``None`` for the one of Mitsuba's ``path``."""
        return None

    def learner(self, setting: Setting, others: Mapping[str, Learner]) -> Learner | None:
        """The learner of this decision, or ``None`` if it does not learn. ``others`` maps the slots
        before this one to their learners."""
        return None

    def parameters(self, slots: Slots = MappingProxyType({})) -> dict[str, Any]:
        """Names and values, for ``str()``, of the parameters that are not empty and have an effect
        with what fills ``slots``."""
        own = {key: value for key, value in vars(self).items() if not key.startswith("_")}
        return {key: value for key, value in own.items() if value != ""}

    def describe(self, slots: Slots = MappingProxyType({})) -> str:
        """Name and :meth:`parameters`, in one line."""
        values = ", ".join(f"{key} = {value}" for key, value in self.parameters(slots).items())
        return f"{self.name}[{values}]" if values else self.name

    def __str__(self) -> str:
        return self.describe()


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


def decisions_of(
    techniques: Slots, setting: Setting, given: Decisions = Decisions()  # noqa: B008  (frozen)
) -> Decisions:
    """The decisions of techniques without learning, of camera paths; ``given`` are the decisions of
    slots that they do not fill."""
    made = {
        slot: technique.decision(replace(setting, slot=slot))
        for slot, technique in techniques.items()
        if slot not in CAMERA_SLOTS
    }
    return replace(given, **{slot: x for slot, x in made.items() if x is not None})
