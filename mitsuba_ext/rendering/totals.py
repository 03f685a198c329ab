"""The total cost of one or more renders."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from ..util.stored_arrays import StoredArrays
from .camera import film_extent
from .statistics import RenderStatistics

#: What is counted of rays and kernels.
_KINDS = {
    "rays": ("camera", "scatter", "shadow"), "kernels": ("launched", "loaded", "compiled"),
}  # fmt: skip


@dataclass(frozen=True)
class RenderTotals:
    """The cost of renders. Unknown values are 0 or empty: Mitsuba's integrators count nothing.

    Attributes:
        rays: Rays traced, by kind: ``camera``, and for integrators of this package ``scatter`` and
            ``shadow``.
        connections: See :class:`~mitsuba_ext.rendering.statistics.RenderStatistics`.
        render_seconds: The sum of the times of all renders, which may have run in parallel
            processes.
        learning_seconds, compile_seconds, tracing_seconds: Parts of ``render_seconds``; see
            :class:`~mitsuba_ext.rendering.statistics.RenderStatistics`.
        kernels: See there; the sum of all renders.
        memory_bytes: Peak of the memory that Dr.Jit held in a render, the scene included.
        learned: Summary of what the integrator has learned.
        effects: See :class:`~mitsuba_ext.rendering.statistics.RenderStatistics`.
    """

    rays: Mapping[str, int] = field(default_factory=dict)
    connections: int = 0
    render_seconds: float = 0.0
    learning_seconds: float = 0.0
    compile_seconds: float = 0.0
    memory_bytes: int = 0
    learned: str = ""
    effects: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    tracing_seconds: float = 0.0
    kernels: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(
        cls, integrator: mi.Integrator, film: mi.Film, spp: int, seconds: float
    ) -> RenderTotals:
        """The cost of an integrator's last render.

        Args:
            film: The film that was rendered to.
            spp: Samples per pixel that were taken.
            seconds: Time of the render.
        """
        own = getattr(integrator, "statistics", None)
        if not isinstance(own, RenderStatistics):
            rays = {"camera": math.prod(film_extent(film)) * spp}
            return cls(rays, render_seconds=seconds, memory_bytes=memory_peak())
        return cls(
            dict(own.rays), own.connections, seconds, own.learning_seconds, own.compile_seconds,
            own.memory, own.learned, own.effects, own.tracing_seconds, own.kernels,
        )  # fmt: skip

    @classmethod
    def of_known(cls, text: str, arrays: StoredArrays) -> RenderTotals:
        """The inverse of :meth:`known`, from its JSON in ``arrays``.

        Raises:
            DamagedError: It is none.
        """
        try:
            known = json.loads(text)
        except (ValueError, RecursionError):
            known = None
        is_sound = isinstance(known, dict) and all(_is_cost(*cost) for cost in known.items())
        arrays.require(is_sound, 'the text "totals" holds no costs')
        return cls(**known)

    def plus(self, later: RenderTotals) -> RenderTotals:
        """The cost of both."""
        return RenderTotals(
            _sums(self.rays, later.rays),
            self.connections + later.connections,
            self.render_seconds + later.render_seconds,
            self.learning_seconds + later.learning_seconds,
            self.compile_seconds + later.compile_seconds,
            max(self.memory_bytes, later.memory_bytes),
            later.learned or self.learned,
            self.effects or later.effects,
            self.tracing_seconds + later.tracing_seconds,
            _sums(self.kernels, later.kernels),
        )

    def known(self) -> dict[str, Any]:
        """The attributes that are not 0 or empty."""
        return {key: value for key, value in asdict(self).items() if value}


def _is_cost(key: str, value: Any) -> bool:
    """Whether an attribute of :class:`RenderTotals` can have this value."""
    if key in _KINDS:
        return isinstance(value, dict) and all(
            kind in _KINDS[key] and _is_number(count) for kind, count in value.items()
        )
    if key == "effects":
        return isinstance(value, dict) and all(isinstance(x, dict) for x in value.values())
    if key == "learned":
        return isinstance(value, str)
    return key in RenderTotals.__dataclass_fields__ and _is_number(value)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and 0 <= value < math.inf


def _sums(one: Mapping[str, int], other: Mapping[str, int]) -> dict[str, int]:
    return {key: one.get(key, 0) + other.get(key, 0) for key in dict.fromkeys([*one, *other])}


def forget_memory_peak() -> None:
    """Resets :func:`memory_peak`."""
    if dr.is_jit_v(mi.Float):
        dr.detail.malloc_clear_statistics()


def memory_peak() -> int:
    """Peak of the memory that Dr.Jit has held, in bytes; 0 in scalar variants."""
    if not dr.is_jit_v(mi.Float):
        return 0
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float))
