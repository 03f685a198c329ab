"""The stages of a render, and who makes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from ..transport.estimator import Estimator
from ..transport.observer import Observer
from .camera_samples import CameraSamples


@dataclass
class Stage:
    """One stage of a render.

    Attributes:
        estimator: What its samples are.
        learned: What had been learned before.
        is_scout: Does it take one sample per pixel that is not added to the film?
        camera: What chooses points of the aperture, times and wavelengths.
        weight: How many samples of the last stage each of its samples counts for. It must not
            depend on any sample.
        most_lanes: Samples of a pass, at most, where passes can be cut anywhere and hold one sample
            of each pixel: what is recorded of each takes memory. 0 for no limit.
        observer: Is told when a pass begins; the estimator tells it the rest.
    """

    estimator: Estimator
    learned: str = ""
    is_scout: bool = False
    camera: CameraSamples = field(default_factory=CameraSamples)
    weight: float = 1.0
    most_lanes: int = 0
    observer: Observer | None = None


class Schedule(Protocol):
    """Makes the stages of one render, one after the other."""

    def next_stage(self) -> Stage:
        """The next stage. All samples of the one before have been taken: what they teach is learned
        now. Scouts come besides the stages of the plan."""


@runtime_checkable
class DivisibleSchedule(Schedule, Protocol):
    """One whose first stage can be divided."""

    def divide_first_stage(self, pixel_count: int) -> int:
        """Into how many stages the first one is divided, each of which takes one sample for a part
        of the pixels: the second is as large as the first, and each later one as large as all
        before it. Called before the first stage, if the render can do so."""


class OneStage:
    """The schedule of an estimator that learns nothing."""

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator

    def next_stage(self) -> Stage:
        return Stage(self._estimator)
