"""The clock around a render, and how many samples a time allows."""

from __future__ import annotations

import gc
import time
from typing import TYPE_CHECKING, NamedTuple

from ..movers import check_motion_is_seen
from ..rendering.batches import sample_count

if TYPE_CHECKING:
    import mitsuba as mi

    from ..rendering.render import RenderStatistics

#: More would not fit into the 2^32 samples of a wavefront even for a film of 16x16 pixels.
_MAX_SPP = 2**24

#: Below this many seconds, a hiccup of the machine can double the time of a render.
_SHORT = 0.5


class Timed(NamedTuple):
    """A render and its cost.

    Attributes:
        seconds: Wall clock of the whole render, learning and compilation included.
        compiled: Did a kernel have to be compiled, or loaded from the disk?
        compile_seconds: How long that took (without tracing).
        launches: Kernels that were launched.
        spp: Samples per pixel that were taken.
        memory: Peak of the memory that Dr.Jit held, the scene included, in bytes.
        image: The developed image.
    """

    seconds: float
    compiled: bool
    compile_seconds: float
    launches: int
    spp: int
    memory: int
    image: mi.TensorXf


def timed_render(
    integrator: mi.Integrator, scene: mi.Scene, seed: int, spp: int, sensor: int = 0
) -> Timed:
    """Renders (``spp`` 0: as many samples as the scene's sampler says) and waits for the image.

    Raises:
        NotImplementedError: Something moves, and the integrator does not see it.
    """
    import drjit as dr
    import mitsuba as mi

    check_motion_is_seen(integrator, scene)

    # What is garbage now must not be found while Dr.Jit traces calls (see garbage.py)
    gc.collect()
    dr.detail.malloc_clear_statistics()
    # The history costs nothing that could be measured
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        image = integrator.render(
            scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=True
        )
        dr.eval(image)
        dr.sync_thread()
        seconds = time.perf_counter() - start
        kernels = dr.kernel_history([dr.KernelType.JIT])
    compiled = [kernel for kernel in kernels if not kernel["cache_hit"]]
    milliseconds = sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in compiled)
    memory = dr.detail.malloc_watermark(dr.backend_v(mi.Float))
    report = own_statistics(integrator)
    return Timed(
        seconds=seconds,
        compiled=bool(compiled),
        compile_seconds=milliseconds / 1000,
        launches=len(kernels),
        spp=report.spp if report else sample_count(scene.sensors()[sensor], spp),
        memory=memory,
        image=image,
    )


def own_statistics(integrator: mi.Integrator) -> RenderStatistics | None:
    """What an integrator of ours says about its last render; Mitsuba's say nothing."""
    from ..rendering.render import RenderStatistics

    report = getattr(integrator, "statistics", None)
    return report if isinstance(report, RenderStatistics) else None


def samples_for(
    budget: float, integrator: mi.Integrator, scene: mi.Scene, seed: int, sensor: int = 0
) -> int:
    """How many samples per pixel take ``budget`` seconds.

    Mitsuba's own integrators ignore a ``timeout`` outside of the scalar variants, and those that
    learn plan their pilot passes by the number of samples: so the speed is measured, and the number
    follows from it. The renders become longer until one takes an eighth of the budget (or four
    seconds); the last two tell the cost of a sample from that of a render.
    """

    def seconds_of(spp: int) -> float:
        seconds, compiled, *_ = timed_render(integrator, scene, seed, spp, sensor)
        if compiled or seconds < _SHORT:
            seconds = min(seconds, timed_render(integrator, scene, seed, spp, sensor).seconds)
        return seconds

    # From 8 on: with fewer, an integrator may have none to learn from
    spp = 8
    shorter = seconds_of(spp)
    if shorter > min(budget / 2, 4):
        return max(1, int(budget / shorter * spp))
    while True:
        spp *= 2
        seconds = seconds_of(spp)
        if seconds >= min(budget / 8, 4) or spp >= _MAX_SPP:
            break
        shorter = seconds
    # At least half the average: short renders are noisy, and a tiny slope would promise anything
    per_sample = max((seconds - shorter) / (spp / 2), seconds / spp / 2)
    fixed = max(0.0, seconds - per_sample * spp)
    return min(_MAX_SPP, max(1, int((budget - fixed) / per_sample)))
