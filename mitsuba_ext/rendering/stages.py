"""The stages of a render, and the schedules that make them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..transport.estimator import Estimator
from ..transport.observer import Observer
from .camera_samples import CameraSamples
from .pass_images import PassImages


@dataclass
class Stage:
    """One stage of a render.

    Attributes:
        estimator: Takes the samples of the stage.
        learned: A summary of what the integrator has learned from earlier stages.
        effects: The effects of learned decisions, by slot
            (:meth:`mitsuba_ext.planning.effect.Effect.as_dict`).
        is_scout: Does it take one sample per pixel that is not added to the film?
        pixels: Of a scout: the pixel of each sample; ``None`` for one sample of each pixel.
        camera: Chooses points of the aperture, times and wavelengths.
        weight: The weight of its samples, in units of the weight of a sample of the last stage. It
            must not depend on any sample.
        most_lanes: Largest number of samples of a pass, since observers record each sample in
            memory; 0 for no limit. A pass still has at least one sample of each pixel. Passes of
            structured samplers ignore it.
        forgets: Are the samples of earlier stages left out of the image? For stages whose samples
            have far less variance.
        observer: Is told when a pass begins. The estimator reports all other events to it.
        images: Gets the images of its passes, of which there are then three at least.
    """

    estimator: Estimator
    learned: str = ""
    effects: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    is_scout: bool = False
    pixels: np.ndarray | None = None
    camera: CameraSamples = field(default_factory=CameraSamples)
    weight: float = 1.0
    most_lanes: int = 0
    forgets: bool = False
    observer: Observer | None = None
    images: PassImages | None = None


class Schedule(Protocol):
    """Makes the stages of one render, one after the other."""

    def next_stage(self) -> Stage:
        """Makes the next stage. All samples of the stage before have been taken, so that this
        method can learn from them. Scouts are returned in addition to the stages of the plan."""


@runtime_checkable
class DivisibleSchedule(Schedule, Protocol):
    """A schedule whose first stage can be divided."""

    def divide_first_stage(self, pixel_count: int) -> int:
        """The number of stages into which the first one is divided. Each of them takes one sample
        for a part of the pixels: the second part is as large as the first, and each later one as
        large as all before it. Called before the first stage, if the render can divide stages."""


@runtime_checkable
class EndingSchedule(Schedule, Protocol):
    """A schedule that can do with fewer pilots."""

    def end_learning(self) -> None:
        """Makes the next stage the last one. Called after a pilot, in renders with a timeout."""


class OneStage:
    """The schedule of an estimator that learns nothing."""

    def __init__(self, estimator: Estimator, camera: CameraSamples | None = None) -> None:
        self._estimator, self._camera = estimator, camera or CameraSamples()

    def next_stage(self) -> Stage:
        return Stage(self._estimator, camera=self._camera)
