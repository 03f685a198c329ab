"""What a render needs from its integrator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import mitsuba as mi

from ..images.coverage import Coverage
from .device import SampleBytes
from .request import Request
from .stages import Learning, Schedule, Stage
from .statistics import RenderStatistics


class Staged(Protocol):
    """The attributes and methods of an integrator that a render uses.

    Attributes:
        statistics: Set when a render begins.
        is_cancelled: Whether the running render is to end after the current pass.
        masks: The names and types of its masks.
        coverage: Set after a render with masks.
        hide_emitters: Whether camera rays pass through area lights.
    """

    name: str
    statistics: RenderStatistics
    is_cancelled: bool
    samples_per_pass: int
    masks: Sequence[tuple[str, str]]
    coverage: Coverage | None
    hide_emitters: bool

    @property
    def sample_cost(self) -> int:
        """The approximate time of a sample, in units of the time of a path."""

    @property
    def sample_bytes(self) -> SampleBytes:
        """The memory of a sample in a pass."""

    @property
    def channel_bytes(self) -> int:
        """The memory of a sample in a pass for the channels of light path expressions."""

    def samples_per_set(self, spp: int) -> int:
        """The number of samples of a pixel that a timeout must not separate."""

    def plan_learning(
        self, request: Request, spp: int, kernels: float = math.inf
    ) -> Learning:
        """What a render of ``spp`` samples per pixel learns.

        Parameters:
            request: What is rendered.
            kernels: How many kernels of the size of ``path`` learning may compile.
        """

    def pace_stage(self, request: Request, spp: int) -> Stage | None:
        """The stage with which a render with a timeout, of at most ``spp`` samples per pixel,
        measures its speed (``pace.py``); ``None`` if the first pilot does that."""

    def schedule(
        self, request: Request, samples: tuple[int, ...], learning: Learning
    ) -> Schedule:
        """The schedule of a render, whose stages take ``samples`` samples per pixel (pilots, and
        the last stage), and which learns as planned."""

    def aov_names(self) -> list[str]:
        """Channels of the film besides colour and alpha."""

    @property
    def has_ray_aovs(self) -> bool:
        """Whether :meth:`sample_aovs` has any."""

    def sample_aovs(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f
    ) -> list[mi.Float]:
        """The values of these channels for camera rays, without those that the estimator returns
        (:attr:`Sample.aovs`)."""

    def no_gradients(self) -> NotImplementedError:
        """The exception to raise if gradients are requested."""


def is_staged(integrator: mi.Integrator) -> bool:
    """Whether an integrator is one of ours that render in stages: its ``render()`` accepts the
    attributes of a :class:`Request` as named arguments."""
    # Not `isinstance`: once another variant is selected, the module holds that variant's class
    return hasattr(integrator, "pace_stage")
