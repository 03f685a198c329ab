"""What a render says of itself, and how its passes are timed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import drjit as dr

from .notebook import statistics_table


@dataclass
class RenderStatistics:
    """The samples, rays, times and memory of a render.

    Attributes:
        passes: Passes whose samples are in the film.
        spp: Samples per pixel that were taken.
        seconds: Wall clock of the whole call, compilation and learning included.
        compile_seconds: Of these, the time to trace the passes for which Dr.Jit compiled kernels,
            and to compile these. Later renders find them in its cache on the disk.
        tracing_seconds: Of ``seconds``, the time to trace and record the other passes, to load
            their kernels and to launch them.
        learning_seconds: Of these, the time before the last stage began.
        rays: Rays traced, by kind: ``camera``, ``scatter`` (found by sampling a BSDF), ``shadow``.
        connections: Connections to lights that were considered; ``path`` traces a shadow ray for
            each, ours only for those that would contribute and that the shadow test lets through.
        zero_radiance: Fraction of the camera samples whose radiance is zero.
        learned: Summary of what the integrator learned, or why it learned nothing; empty if it does
            not learn.
        effects: For each learned decision (``directions``, ``next_event``, ``light_paths``, …):
            ``is_kept``, the ``variance`` and ``time`` that pilots predict in units of those
            without it, and what else was chosen
            (:class:`~mitsuba_ext.planning.prediction.Effect`; of light paths,
            :class:`~mitsuba_ext.estimators.light_paths.choice.predicted_errors.PredictedErrors`).
        memory: Peak of the memory that Dr.Jit held during the render, in bytes.
        kernels: The kernels that were ``launched``, and of these the ``loaded`` ones, which came
            from the disk, and the ``compiled`` ones. (Those of other threads count, too.)
        interrupted: Did Ctrl-C, :meth:`cancel` or an error end the render before all samples were
            taken? Ctrl-C in the last pass does not.
    """

    passes: int = 0
    spp: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    learning_seconds: float = 0.0
    rays: dict[str, int] = field(
        default_factory=lambda: {"camera": 0, "scatter": 0, "shadow": 0}
    )
    connections: int = 0
    zero_radiance: float = 0.0
    learned: str = ""
    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    memory: int = 0
    interrupted: bool = False
    tracing_seconds: float = 0.0
    kernels: dict[str, int] = field(default_factory=dict)

    def add_tracing(self, seconds: float, compiled: bool) -> None:
        """Adds the time before the kernels of a pass run; were some of them compiled?"""
        if compiled:
            self.compile_seconds += seconds
        else:
            self.tracing_seconds += seconds

    def add_learned(self, text: str) -> None:
        """Adds to the summary of what was learned."""
        self.learned = "; ".join(filter(None, (self.learned, text)))

    def _repr_html_(self) -> str:
        return statistics_table(self)


def kernel_cache_misses() -> int:
    """The number of kernels that this process has compiled, or loaded from the disk."""
    _launches, soft_misses, hard_misses = dr.detail.launch_stats()
    return soft_misses + hard_misses


class PassTimer:
    """Times a pass from now on."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self._misses, self._compiled = kernel_cache_misses(), _kernels_compiled()

    @property
    def seconds(self) -> float:
        """Seconds since the pass began."""
        return time.perf_counter() - self._begin

    @property
    def has_compiled(self) -> bool:
        """Whether kernels have been compiled since then: they were in no cache."""
        return _kernels_compiled() > self._compiled

    @property
    def has_new_kernels(self) -> bool:
        """Whether kernels have been compiled since then, or loaded from the disk. If so, the time
        does not tell the speed."""
        return kernel_cache_misses() > self._misses


def _kernels_compiled() -> int:
    return dr.detail.launch_stats()[2]
