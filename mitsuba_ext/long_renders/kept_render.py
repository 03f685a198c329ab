"""The parameter ``checkpoint`` of our integrators: a render that is saved in a folder."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..inputs.content_hash import hash_code
from ..rendering.batches import sample_count
from ..rendering.interrupts import deferred_interrupt
from ..rendering.request import Watch
from ..rendering.turns import tell
from ..scene.fingerprint import fingerprint
from ..scene.nesting import with_nested
from ..startup.machine import versions
from .folder import CheckpointFolder
from .integrator_batches import IntegratorBatches
from .intervals import Interval, LastKept
from .long_render import Goal, LongRender
from .state import Batch, BatchResult, RenderState


class KeptRender:
    """A render in batches that is saved in a folder and continued from it.

    Parameters:
        integrator: An integrator whose ``render()`` renders a batch, and which has the attribute
            ``is_cancelled``.
        folder, every: The folder, and the interval at which the render is saved.
        parameters: The integrator's parameters on which the image depends.
    """

    def __init__(
        self, integrator: mi.Integrator, folder: Path, every: Interval, parameters: str
    ) -> None:
        self._integrator, self._every, self._parameters = integrator, every, parameters
        self._folder = CheckpointFolder(folder)

    def run(
        self,
        scene: mi.Scene,
        sensor: mi.Sensor,
        seed: int,
        spp: int,
        seconds: float | None = None,
        progress: Callable[[float], None] | None = None,
        watch: Watch | None = None,
    ) -> tuple[RenderState, bool]:
        """Renders the missing batches, and puts the image of all batches into the film. Returns the
        state of the render, and whether it was interrupted.

        Args:
            spp: Samples per pixel of the whole image; 0 for the sampler's number.
            seconds: The time limit of this call, in seconds; ``None`` for none.
            progress: A function that is called after each batch with the fraction done.
            watch: Is shown the unfinished image; ``None`` if nobody watches.

        Raises:
            InputError: The folder holds another render, or cannot be used.
            KeyboardInterrupt: Ctrl-C was pressed before the first batch was done.
        """
        goal = Goal(sample_count(sensor, spp), seconds=seconds)
        batches = _Batches(self._integrator, scene, sensor, seed)
        sensor.film().prepare(self._integrator.aov_names())
        with self._folder.in_use():
            self._folder.describe(self._description(scene, sensor, seed))
            state = self._folder.load(sensor.film())
            if damaged := self._folder.damaged:
                mi.Log(
                    mi.LogLevel.Warn, f"{damaged}: is damaged: continuing from the previous state"
                )
            if state.done:
                self._say_what_is_kept(state.spp, goal.spp or 0)
            last = LastKept(state.spp)

            def after_batch(render: LongRender) -> None:
                if last.is_due(self._every, state.spp):
                    last.mark(state.spp)
                    self._save(state)
                if watch is not None and watch.is_due():
                    state.fill(sensor.film())
                    watch.show(sensor.film(), state.spp, None)
                if progress is not None:
                    tell(progress, min(1.0, state.spp / (render.goal_spp or goal.spp)))

            render = LongRender(batches, state, after_batch)
            is_interrupted = False
            with deferred_interrupt() as interrupt:

                def is_stopped() -> bool:
                    return interrupt.is_set() or self._integrator.is_cancelled

                try:
                    render.run(goal, is_stopped)
                except _CancelledError:
                    pass
                except KeyboardInterrupt:
                    is_interrupted = True
                finally:
                    if state.done:
                        state.fill(sensor.film())
                        self._save(state)
                is_interrupted |= interrupt.is_set()
        if is_interrupted and not state.done:
            raise KeyboardInterrupt
        return state, is_interrupted

    def _say_what_is_kept(self, kept: int, spp: int) -> None:
        where, has = f'"{self._integrator.name}": {self._folder.path}', f"{kept} samples per pixel"
        if kept > spp:
            text = f"{where} holds {has}, and the image shows all of them, not {spp}"
            mi.Log(mi.LogLevel.Warn, text)
        else:
            mi.Log(mi.LogLevel.Info, f"{where}: continued from {has}")

    def _save(self, state: RenderState) -> None:
        try:
            self._folder.save(state)
        except OSError as problem:  # a full disk may have room later
            mi.Log(mi.LogLevel.Warn, f"the render could not be saved: {problem}")

    def _description(self, scene: mi.Scene, sensor: mi.Sensor, seed: int) -> dict[str, Any]:
        """Everything on which the image depends, except the number of samples."""
        integrator, film = self._integrator, sensor.film()
        return {
            "scene hash": fingerprint(scene) + _digest_of_text(scene),
            "size": "x".join(map(str, film.crop_size())),
            "integrator": integrator.name,
            "parameters": self._parameters,
            "integrator hash": hash_code(type(each) for each in with_nested(integrator)),
            "sensor hash": _digest(sensor),
            "seed": seed,
            "versions": {k: v for k, v in versions().items() if k not in ("numpy", "python")},
        }


class _CancelledError(Exception):
    """The running batch was cancelled."""


class _Batches(IntegratorBatches):
    """Discards a cancelled batch, because it lacks samples."""

    def render(self, batch: Batch, learned: bytes | None = None) -> BatchResult:
        result = super().render(batch, learned)
        if self._integrator.is_cancelled:
            raise _CancelledError
        return result


def _digest_of_text(scene: mi.Scene) -> str:
    """A hash of the ``str()`` of shapes and lights. It covers settings that the fingerprint does
    not cover, such as the distribution of a microfacet BSDF."""
    parts = [*scene.shapes(), *scene.emitters()]
    text = sorted(re.sub("0x[0-9a-f]+", "", str(part)) for part in parts)  # without addresses
    return hashlib.sha256("".join(text).encode()).hexdigest()


def _digest(sensor: mi.Sensor) -> str:
    """A hash of a sensor, its film, filter and sampler."""
    values, film = mi.traverse(sensor), sensor.film()
    text = [f"{key}={values[key]}" for key in sorted(values.keys())]
    text += [sensor.class_name(), sensor.sampler().class_name(), film.class_name()]
    text += [film.rfilter(), film.size(), film.crop_offset(), getattr(sensor, "motion", "")]
    return hashlib.sha256(" ".join(map(str, text)).encode()).hexdigest()
