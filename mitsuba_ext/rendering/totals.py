"""What renders cost together: of one, or of many batches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from .camera import film_extent


@dataclass(frozen=True)
class RenderTotals:
    """The cost of renders. What is unknown is 0 or empty: Mitsuba's integrators count nothing.

    Attributes:
        rays: Rays traced, by kind: ``camera``, and of integrators of ours ``scatter`` and
            ``shadow``.
        connections: See :class:`~mitsuba_ext.rendering.render.RenderStatistics`.
        render_seconds: The sum of the renders' times. Processes may share them.
        learning_seconds, compile_seconds: Of these.
        memory_bytes: The most that Dr.Jit held in a render, the scene included.
        learned: What the integrator has learned, in words.
    """

    rays: Mapping[str, int] = field(default_factory=dict)
    connections: int = 0
    render_seconds: float = 0.0
    learning_seconds: float = 0.0
    compile_seconds: float = 0.0
    memory_bytes: int = 0
    learned: str = ""

    @classmethod
    def of(
        cls, integrator: mi.Integrator, film: mi.Film, spp: int, seconds: float
    ) -> RenderTotals:
        """The cost of an integrator's last render.

        Args:
            film: That of the image.
            spp: Samples per pixel that were taken.
            seconds: The render's time.
        """
        # It needs an active variant
        from .render import RenderStatistics

        own = getattr(integrator, "statistics", None)
        if not isinstance(own, RenderStatistics):
            rays = {"camera": math.prod(film_extent(film)) * spp}
            return cls(rays, render_seconds=seconds, memory_bytes=memory_peak())
        return cls(
            dict(own.rays), own.connections, seconds, own.learning_seconds, own.compile_seconds,
            own.memory, own.learned,
        )  # fmt: skip

    def plus(self, later: RenderTotals) -> RenderTotals:
        """The cost of both."""
        kinds = dict.fromkeys([*self.rays, *later.rays])
        return RenderTotals(
            {kind: self.rays.get(kind, 0) + later.rays.get(kind, 0) for kind in kinds},
            self.connections + later.connections,
            self.render_seconds + later.render_seconds,
            self.learning_seconds + later.learning_seconds,
            self.compile_seconds + later.compile_seconds,
            max(self.memory_bytes, later.memory_bytes),
            later.learned or self.learned,
        )

    def known(self) -> dict[str, Any]:
        """The attributes that are known."""
        return {key: value for key, value in asdict(self).items() if value}


def forget_memory_peak() -> None:
    """Lets :func:`memory_peak` begin anew."""
    if dr.is_jit_v(mi.Float):
        dr.detail.malloc_clear_statistics()


def memory_peak() -> int:
    """The most bytes that Dr.Jit has held; 0 in variants without Dr.Jit's memory."""
    if not dr.is_jit_v(mi.Float):
        return 0
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float))
