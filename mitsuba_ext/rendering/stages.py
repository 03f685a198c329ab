"""The stages of a render, and the schedules that make them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..transport.decisions import CameraSamples
from ..transport.estimator import Estimator
from ..transport.observer import Observer
from .pass_images import PassImages
from .statistics import RenderStatistics


@dataclass(frozen=True)
class Stage:
    """One stage of a render.

    Attributes:
        estimator: Takes the samples of the stage.
        learned: A summary of what the integrator has learned from earlier stages.
        effects: The effects of learned decisions, by slot
            (:meth:`mitsuba_ext.planning.prediction.Effect.as_dict`).
        is_scout: Whether it takes one sample per pixel that is not added to the film.
        pixels: Of a scout: the pixel of each sample; ``None`` for one sample of each pixel.
        camera: Chooses points of the aperture, times and wavelengths.
        weight: The weight of its samples, in units of the weight of a sample of the last stage that
            is planned. It must not depend on any sample, nor on what earlier stages have learned.
        most_lanes: Largest number of samples of a pass, since observers record each sample in
            memory; 0 for no limit. A pass still has at least one sample of each pixel. Passes of
            structured samplers ignore it.
        discards_earlier: Whether the samples of earlier stages are left out of the image, because
            the samples of this one have far less variance. It must not depend on those samples.
        observer: Is told when a pass begins. The estimator reports all other events to it.
        images: Gets the images of its passes, of which there are then three at least.
    """

    estimator: Estimator
    learned: str = ""
    effects: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    is_scout: bool = False
    pixels: np.ndarray | None = None
    camera: CameraSamples = CameraSamples()
    weight: float = 1.0
    most_lanes: int = 0
    discards_earlier: bool = False
    observer: Observer | None = None
    images: PassImages | None = None


@dataclass(frozen=True)
class Learning:
    """What a render learns. Integrators that learn extend it by what their schedules need.

    Attributes:
        pilots: Samples per pixel of each pilot stage; empty if nothing is learned.
    """

    pilots: tuple[int, ...] = ()


class Schedule(ABC):
    """Makes the stages of one render, one after the other."""

    @abstractmethod
    def next_stage(self) -> Stage:
        """Makes the next stage. All samples of the stage before have been taken, so that this
        method can learn from them. Scouts are returned in addition to the stages of the plan."""

    @abstractmethod
    def divide_first_stage(self, pixel_count: int) -> int:
        """The number of stages into which the first one is divided; 1 if it is not. Each of them
        takes one sample for a part of the pixels: the second part is as large as the first, and
        each later one as large as all before it. Called before the first stage, if the render can
        divide stages."""

    @abstractmethod
    def end_learning(self) -> None:
        """Makes the next stage the last one. Called after a pilot, in renders with a timeout."""

    @abstractmethod
    def finish(self, statistics: RenderStatistics) -> None:
        """Called after the render, unless an exception or Ctrl-C ended it. ``statistics`` are those
        of the render; what they say of it may be added to."""


class OneStage(Schedule):
    """The schedule of an estimator that learns nothing."""

    def __init__(self, estimator: Estimator, camera: CameraSamples | None = None) -> None:
        self._estimator, self._camera = estimator, camera or CameraSamples()

    def next_stage(self) -> Stage:
        return Stage(self._estimator, camera=self._camera)

    def divide_first_stage(self, pixel_count: int) -> int:
        return 1

    def end_learning(self) -> None:
        pass

    def finish(self, statistics: RenderStatistics) -> None:
        pass


class ChangedSchedule(Schedule):
    """A schedule that changes the stages of another one."""

    def __init__(self, inner: Schedule) -> None:
        self._inner = inner

    @abstractmethod
    def changed(self, stage: Stage) -> Stage:
        """The stage that is rendered in the place of ``stage``."""

    def next_stage(self) -> Stage:
        return self.changed(self._inner.next_stage())

    def divide_first_stage(self, pixel_count: int) -> int:
        return self._inner.divide_first_stage(pixel_count)

    def end_learning(self) -> None:
        self._inner.end_learning()

    def finish(self, statistics: RenderStatistics) -> None:
        self._inner.finish(statistics)


class ReportedSchedule(ChangedSchedule):
    """A schedule whose render is reported when it has ended.

    Parameters:
        report: Is called in :meth:`finish`.
    """

    def __init__(self, inner: Schedule, report: Callable[[RenderStatistics], None]) -> None:
        super().__init__(inner)
        self._report = report

    def changed(self, stage: Stage) -> Stage:
        return stage

    def finish(self, statistics: RenderStatistics) -> None:
        super().finish(statistics)
        self._report(statistics)
