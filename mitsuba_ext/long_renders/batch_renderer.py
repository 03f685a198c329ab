"""Renders the batches of a scene file, in any process."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..inputs.chosen import LastScene
from ..inputs.scene_changes import UNCHANGED, SceneChanges
from ..scene.nesting import with_nested
from ..startup.machine import versions
from ..util.errors import InputError, one_line
from .bundle import Bundle
from .integrator_batches import IntegratorBatches
from .state import Batch, BatchResult


@dataclass(frozen=True)
class RenderRequest:
    """A description of what to render, which can be sent to other processes and machines.

    Attributes:
        scene: The file.
        size: Width and height of the image in pixels; ``None`` for the film's.
        definitions: Values of the file's ``$name`` parameters, as pairs.
        specification: The integrator, as on the command line; ``None`` for the command's default.
        sensor: The index of the sensor.
        seed: The seed of the random numbers.
        variant: Mitsuba's variant.
        plugins: Modules that register other plugins.
        threads: The number of threads of a process; 0 for the number of cores.
        values: Values of the loaded scene's parameters, from
            :func:`~mitsuba_ext.inputs.scene_values.as_text`; ``None`` if no frame has any.
        changes: The changes to the film and the depth.
        description: Everything on which the image depends, as JSON. A process refuses the request
            if its files or versions give another description. Empty to skip this check.
    """

    scene: str
    size: tuple[int, int] | None = None
    definitions: tuple[tuple[str, str], ...] = ()
    specification: str | None = None
    sensor: int = 0
    seed: int = 0
    variant: str = "llvm_ad_rgb"
    plugins: tuple[str, ...] = ()
    threads: int = 0
    values: str | None = None
    changes: SceneChanges = UNCHANGED
    description: str = ""


class BatchRenderer(IntegratorBatches):
    """Renders the batches of a request.

    Parameters:
        request: The request, whose variant is the active one.
        bundle: The scene's files; ``None`` to read them from their paths.
        scenes: Keeps the loaded scene for the next render.

    Attributes:
        request: The request.
        chosen: The scene, the integrator and the sensor.

    Raises:
        InputError: The scene, the integrator or the sensor cannot be used.
    """

    def __init__(
        self, request: RenderRequest, bundle: Bundle | None = None, scenes: LastScene | None = None
    ) -> None:
        self.request = request
        with bundle.unpacked() if bundle else contextlib.nullcontext() as moved:
            scene, specification = request.scene, request.specification
            if moved:
                scene, specification = moved(scene), specification and moved(specification)
            self.chosen = (scenes or LastScene()).choose(
                Path(scene), request.size, dict(request.definitions), specification,
                request.sensor, request.values, moved, request.changes,
            )  # fmt: skip
        self.chosen.loaded.path = Path(request.scene)
        integrator = self.chosen.named.integrator
        its_parameter = f'{self.chosen.loaded.source}: "{self.chosen.named.name}": its parameter'
        if any(getattr(each, "checkpoint", "") for each in with_nested(integrator)):
            raise InputError(
                f'{its_parameter} "checkpoint" already saves the render: leave it out, or the '
                f"options of the command"
            )
        if any(getattr(each, "timeout", 0) > 0 for each in with_nested(integrator)):
            raise InputError(
                f'{its_parameter} "timeout" would cut short each of the batches in which this '
                f"render is divided: leave it out, and limit the whole render by --time"
            )
        super().__init__(integrator, self.chosen.scene, self.chosen.sensor, request.seed)

    def description(self) -> dict[str, Any]:
        """Everything on which the image depends, except the number of samples."""
        request, film = self.request, self.sensor.film()
        loaded, named = self.chosen.loaded, self.chosen.named
        folder = loaded.path.resolve().parent
        return {
            "scene": loaded.source,
            "scene parameters": loaded.parameters,
            **request.changes.described(),
            "scene files hash": loaded.content_hash,
            "scene files": {
                os.path.relpath(file, folder): found for file, found in loaded.file_hashes.items()
            },
            **({"values of the scene": request.values} if request.values else {}),
            "size": "x".join(map(str, film.crop_size())),
            "integrator": named.name,
            "parameters": named.parameters,
            "integrator hash": named.identity,
            "sensor": request.sensor,
            "seed": request.seed,
            "versions": {k: v for k, v in versions().items() if k not in ("numpy", "python")},
        }

    def render(self, batch: Batch, learned: bytes | None = None) -> BatchResult:
        """
        Raises:
            InputError: The integrator cannot render this scene.
            KeyboardInterrupt: The batch was interrupted, and is lost.
        """
        try:
            return super().render(batch, learned)
        except (ValueError, TypeError, RuntimeError) as error:
            source, name = self.chosen.loaded.source, self.chosen.named.name
            raise InputError(f'{source}: "{name}": {one_line(error)}') from error
