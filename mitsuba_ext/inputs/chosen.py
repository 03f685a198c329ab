"""The scene, integrator and sensor that a command renders."""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from ..startup.runtime import SUPPORTED_VARIANTS
from ..util.errors import InputError
from .content_hash import hash_code
from .names import OF_SCENE
from .scene_changes import UNCHANGED, SceneChanges
from .scene_remarks import scene_remarks
from .scene_values import SceneValues
from .scenes import LoadedScene, load_scene
from .specifications import NamedIntegrator, make_named, names_masks

#: The integrator for scenes that specify ``path`` or none, if the user names none.
DEFAULT = "auto"


@dataclass
class Chosen:
    """A scene with the integrator and the sensor that render it.

    Attributes:
        loaded: The scene.
        named: The integrator.
        sensor_index: The index of the sensor.
        note: A sentence about the integrator if the user named none and it is :data:`DEFAULT`, or
            would be in another variant; otherwise empty.
    """

    loaded: LoadedScene
    named: NamedIntegrator
    sensor_index: int
    note: str = ""

    @classmethod
    def of(cls, loaded: LoadedScene, specification: str | None, sensor_index: int) -> Chosen:
        """
        Args:
            loaded: The scene, with its integrator if ``specification`` is ``None``.
            specification: The integrator; :data:`OF_SCENE` for the scene's own. ``None`` for the
                scene's own, except that :data:`DEFAULT` replaces ``path`` or a missing one in
                variants that it supports.

        Raises:
            InputError: The integrator or the sensor cannot be used.
        """
        wants_default = specification is None and loaded.only_says_path
        is_default = wants_default and mi.variant() in SUPPORTED_VARIANTS
        if is_default:
            specification = DEFAULT
        if specification in (None, OF_SCENE):
            named = _of_scene(loaded)
        else:
            named = make_named(specification, loaded.settings)
        count = len(loaded.scene.sensors())
        if sensor_index >= count:
            raise InputError(
                f"{loaded.source}: there is no sensor {sensor_index}: the scene has {count}"
            )
        note = _note(loaded.integrator_name, is_default) if wants_default else ""
        return cls(loaded, named, sensor_index, note)

    @property
    def scene(self) -> mi.Scene:
        return self.loaded.scene

    @property
    def sensor(self) -> mi.Sensor:
        return self.scene.sensors()[self.sensor_index]

    def remarks(self, is_sensor_chosen: bool) -> list[str]:
        """Warnings about parts of the scene that the image will not show."""
        remarks = scene_remarks(self.loaded, self.named.integrator, self.named.name)
        count = len(self.scene.sensors())
        if count > 1 and not is_sensor_chosen:
            remarks.append(f"the scene has {count} sensors: the first is rendered (see --sensor)")
        return remarks


class LastScene:
    """Keeps the last loaded scene for further images of the same scene."""

    def __init__(self) -> None:
        self._key: tuple | None = None
        self._loaded: LoadedScene | None = None
        self._values: SceneValues | None = None

    def choose(
        self, path: Path, size: tuple[int, int] | None, definitions: Mapping[str, str],
        specification: str | None, sensor_index: int, values: str | None = None,
        moved: Callable[[str], str] | None = None, changes: SceneChanges = UNCHANGED,
    ) -> Chosen:  # fmt: skip
        """Loads the scene of a file, and makes its integrator.

        Args:
            path: The file.
            size: Size of the image; ``None`` for the film's.
            definitions: Values of the file's ``$name`` parameters.
            specification: The integrator; see :meth:`Chosen.of`.
            values: Values of parameters of the loaded scene, from :func:`.scene_values.as_text`;
                ``None`` if no image of the call has any.
            moved, changes: Arguments of :func:`.scenes.load_scene`.

        Raises:
            InputError: The scene, the integrator or the sensor cannot be used.
        """
        is_own, has_values = specification in (None, OF_SCENE), values is not None
        items = tuple(definitions.items())
        keeps_names = has_values or names_masks(specification)
        key = (mi.variant(), path, size, items, is_own, keeps_names, changes)
        if key != self._key:
            # Free the last scene first, because Dr.Jit compiles the methods of all living objects
            self._key = self._loaded = self._values = None
            gc.collect()  # the object that mi.traverse returns refers to itself
            self._loaded = load_scene(
                path, size, definitions, is_own, keeps_names, moved, changes
            )
            self._values = SceneValues(self._loaded.scene) if has_values else None
            self._key = key
        if self._values:
            self._values.set(values or "")
        return Chosen.of(self._loaded, specification, sensor_index)


def _note(name: str, is_default: bool) -> str:
    """See :attr:`Chosen.note`.

    Args:
        name: The scene's integrator; empty if there is none.
    """
    if not is_default:
        return (
            f'"{name}" renders this scene: "{DEFAULT}" would, but the integrators of mitsuba_ext '
            f'do not work in the variant "{mi.variant()}" (they do in "{SUPPORTED_VARIANTS[0]}")'
        )
    if not name:
        return f'"{DEFAULT}" renders this scene, which names no integrator'
    return (
        f'"{DEFAULT}" renders this scene, in place of its "{name}" (which --integrator {OF_SCENE} '
        f"would use)"
    )


def _of_scene(loaded: LoadedScene) -> NamedIntegrator:
    integrator, name = loaded.scene.integrator(), loaded.integrator_name
    if integrator is None:
        raise InputError(
            f"{loaded.source}: the scene has no integrator: name one with --integrator"
        )
    # The identity covers only the code: the hash of the scene's files covers the parameters
    code = hash_code([type(integrator)]) or ""
    return NamedIntegrator(name, name, dict(loaded.settings), integrator, code)
