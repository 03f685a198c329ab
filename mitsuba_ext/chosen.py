"""What a command renders: a scene file, an integrator, a sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from .content_hash import hash_code
from .errors import InputError
from .scene_remarks import scene_remarks
from .scenes import LoadedScene, load_scene
from .specifications import NamedIntegrator, make_named


@dataclass
class Chosen:
    """A scene, with what renders it.

    Attributes:
        loaded: The scene.
        named: The integrator.
        sensor_index: The number of the sensor.
    """

    loaded: LoadedScene
    named: NamedIntegrator
    sensor_index: int

    @classmethod
    def load(
        cls, path: Path, size: tuple[int, int] | None, definitions: Mapping[str, str],
        specification: str | None, sensor_index: int,
        moved: Callable[[str], str] | None = None,
    ) -> Chosen:  # fmt: skip
        """
        Args:
            path: The scene's file.
            size: Of the image; ``None`` for the film's.
            definitions: Values of the file's ``$name`` parameters.
            specification: The integrator; ``None`` for the scene's.
            moved: See :func:`~mitsuba_ext.scenes.load_scene`.

        Raises:
            InputError: The scene, the integrator or the sensor cannot be used.
        """
        loaded = load_scene(path, size, definitions, specification is None, moved)
        named = _of_scene(loaded) if specification is None else make_named(
            specification, loaded.settings
        )
        count = len(loaded.scene.sensors())
        if sensor_index >= count:
            raise InputError(f"{path}: there is no sensor {sensor_index}: the scene has {count}")
        return cls(loaded, named, sensor_index)

    @property
    def scene(self) -> mi.Scene:
        return self.loaded.scene

    @property
    def sensor(self) -> mi.Sensor:
        return self.scene.sensors()[self.sensor_index]

    def remarks(self, is_sensor_chosen: bool) -> list[str]:
        """Warnings about what the image will not show."""
        remarks = scene_remarks(self.scene, self.sensor, self.named.integrator, self.named.name)
        count = len(self.scene.sensors())
        if count > 1 and not is_sensor_chosen:
            remarks.append(f"the scene has {count} sensors: the first is rendered (see --sensor)")
        return remarks


def _of_scene(loaded: LoadedScene) -> NamedIntegrator:
    integrator, name = loaded.scene.integrator(), loaded.integrator_name
    if integrator is None:
        raise InputError(
            f"{loaded.source}: the scene has no integrator: name one with --integrator"
        )
    # The scene's files have its parameters
    code = hash_code([type(integrator)]) or ""
    return NamedIntegrator(name, name, dict(loaded.settings), integrator, code)
