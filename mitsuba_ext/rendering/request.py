"""What a call of ``render()`` asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from .statistics import RenderStatistics


class Watch(Protocol):
    """Whoever watches a render (:class:`mitsuba_ext.live.viewer.Viewer`)."""

    def is_due(self) -> bool:
        """Whether it wants to see the image now. Called after each pass."""

    def show(self, film: mi.Film, spp: int, statistics: RenderStatistics | None) -> None:
        """Called if it does.

        Args:
            film: Holds the image so far.
            spp: Samples per pixel of that image.
            statistics: What the render says of itself; ``None`` for Mitsuba's integrators.
        """


@dataclass(frozen=True)
class Request:
    """What one call of ``render()`` asks for. It is passed on as a value, so that a render changes
    no parameter of its integrator.

    Attributes:
        scene, sensor, seed: What is rendered. The seed is an array while a user records a whole
            step (``dr.freeze``) with such a seed.
        spp: Samples per pixel; 0 for the number of the sampler.
        develop, evaluate: See ``mi.Integrator.render``.
        timeout: Seconds after which to stop; 0 or less for no limit.
        progress: Called after each pass with the fraction done; ``None`` for no calls.
        watch: Is shown the unfinished image; ``None`` if nobody watches.
        is_batch: Whether it is one of several batches of a render. A batch is not saved in the
            folder ``checkpoint``, and does not forget that the render was cancelled before it.
        samples_before: Samples per pixel of the batches with smaller numbers.
        save_learned, load_learned: Files in the place of the parameters of these names; empty for
            the parameters.
        job: Makes what takes the samples (:class:`mitsuba_ext.rendering.render.Job`) from the
            integrator and the request; ``None`` for the integrator's own choice.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: int | mi.UInt32 = 0
    spp: int = 0
    develop: bool = True
    evaluate: bool = True
    timeout: float = -1.0
    progress: Callable[[float], None] | None = None
    watch: Watch | None = None
    is_batch: bool = False
    samples_before: int = 0
    save_learned: str = ""
    load_learned: str = ""
    job: Callable[..., Any] | None = None

    @property
    def is_timed(self) -> bool:
        """Whether a timeout can end the render before it has all samples."""
        return self.timeout > 0
