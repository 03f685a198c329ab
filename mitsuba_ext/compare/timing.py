"""Times renders, and computes how many samples take a given time."""

from __future__ import annotations

import gc
import time
from typing import TYPE_CHECKING, NamedTuple

from ..rendering.batches import sample_count
from ..rendering.camera import forget_state
from ..rendering.statistics import RenderStatistics
from ..scene.unseen import check_all_is_seen

if TYPE_CHECKING:
    import mitsuba as mi

#: Limit of ``samples_for``: with more, even a film of 16x16 pixels exceeds the 2^32 samples of a
#: wavefront.
_MAX_SPP = 2**24

#: A render shorter than this (in seconds) is timed twice, as a short disturbance can double its
#: time.
_SHORT = 0.5


class Timed(NamedTuple):
    """A render and its cost.

    Attributes:
        seconds: Wall clock time of the whole render, learning and compilation included.
        compiled: Was a kernel compiled, or loaded from the disk?
        compile_seconds: Time to compile or load kernels, without tracing.
        launches: Number of kernel launches.
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
    """Renders and waits for the image. ``spp`` 0 stands for the number of the scene's sampler.

    Raises:
        NotImplementedError: The scene has moving shapes, and the integrator does not support them.
    """
    import drjit as dr
    import mitsuba as mi

    check_all_is_seen(integrator, scene)

    # Free garbage now: the collector must not free it while Dr.Jit traces calls (see garbage.py)
    gc.collect()
    dr.detail.malloc_clear_statistics()
    # Recording the kernel history has no measurable cost
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
    forget_state(scene.sensors()[sensor])
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
    """Statistics of the last render, if the integrator is one of ours; else ``None``."""
    report = getattr(integrator, "statistics", None)
    return report if isinstance(report, RenderStatistics) else None


def samples_for(
    budget: float, integrator: mi.Integrator, scene: mi.Scene, seed: int, sensor: int = 0
) -> int:
    """How many samples per pixel take ``budget`` seconds.

    Mitsuba's own integrators ignore ``timeout`` outside of the scalar variants, and integrators
    that learn plan their pilot passes by the number of samples. Therefore, this function measures
    the speed and computes the number. It doubles the samples until a render takes an eighth of the
    budget (or four seconds). The last two renders give the cost of a sample and the fixed cost of a
    render.
    """

    def seconds_of(spp: int) -> float:
        seconds, compiled, *_ = timed_render(integrator, scene, seed, spp, sensor)
        if compiled or seconds < _SHORT:
            seconds = min(seconds, timed_render(integrator, scene, seed, spp, sensor).seconds)
        return seconds

    # Start with 8: with fewer, an integrator may have no pilot pass
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
    # At least half the average: the difference of two noisy times can be close to zero
    per_sample = max((seconds - shorter) / (spp / 2), seconds / spp / 2)
    fixed = max(0.0, seconds - per_sample * spp)
    return min(_MAX_SPP, max(1, int((budget - fixed) / per_sample)))
