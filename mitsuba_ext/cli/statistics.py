"""Describes the cost of a render and what it learned, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

from ..rendering.totals import RenderTotals

_KINDS = {"camera": "from the camera", "scatter": "scattered", "shadow": "to lights"}


def lines(
    totals: RenderTotals, integrator: str, seeds: Sequence[int], versions: dict[str, str]
) -> list[str]:
    """The sentences that follow "image.exr: 64 spp in 1.0 s".

    Args:
        seeds: The seeds of the samples in the image.
        versions: The result of :func:`~mitsuba_ext.startup.machine.versions`.
    """
    names = ", ".join(map(str, seeds[:4])) + (", …" if len(seeds) > 4 else "")
    found = [
        f"{integrator}, seed{'s' if len(seeds) > 1 else ''} {names}, {versions['variant']}, "
        f"mitsuba_ext {versions['mitsuba_ext']}, Mitsuba {versions['mitsuba']}"
    ]
    costs = []
    rays = [f"{_count(n)} {_KINDS[kind]}" for kind, n in totals.rays.items() if n]
    if rays:
        costs.append("rays: " + ", ".join(rays))
    if totals.learning_seconds > 0:
        costs.append(f"learning {totals.learning_seconds:.1f} s")
    if totals.compile_seconds > 0:
        costs.append(f"compiling {totals.compile_seconds:.1f} s")
    if totals.tracing_seconds > 0:
        costs.append(f"tracing {totals.tracing_seconds:.1f} s")
    if totals.memory_bytes:
        costs.append(f"memory {totals.memory_bytes / 2**20:.0f} MiB")
    found.append("; ".join(costs))
    if totals.learned:
        found.append(f"learned: {totals.learned}")
    return [f"  {line}" for line in found if line]


def _count(number: int) -> str:
    for size, word in ((1e9, " billion"), (1e6, " million"), (1e3, " thousand")):
        if number >= size:
            return f"{number / size:.3g}{word}"
    return str(number)
