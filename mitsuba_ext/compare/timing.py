"""Measures the time of renders, and renders for a given time."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from ..rendering.batches import sample_count
from ..rendering.camera import film_extent, forget_state
from ..rendering.plan import is_independent
from ..rendering.request import Request
from ..rendering.staged import is_staged
from ..rendering.statistics import RenderStatistics
from ..scene.unseen import check_all_is_seen

if TYPE_CHECKING:
    import mitsuba as mi

#: The maximum samples per pixel of ``samples_for``: with more, even a film of 16x16 pixels exceeds
#: the 2^32 samples of a wavefront.
_MAX_SPP = 2**24

#: The ratio of a render's time to the time predicted from its samples that counts as a jump.
_JUMP_RATIO = 1.25

#: The time, in seconds, below which renders are timed twice: a disturbance can double it.
_SHORT_SECONDS = 0.5


class Timed(NamedTuple):
    """A render and its cost.

    Attributes:
        seconds: Time of the whole render (wall clock, or CPU time of all threads), including
            learning and compilation.
        compiled: Whether a kernel was compiled or loaded from the disk.
        compile_seconds: The time to compile or load kernels, without tracing.
        launches: Number of kernel launches.
        spp: Samples per pixel taken.
        memory: Dr.Jit's peak memory, including the scene, in bytes.
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
    integrator: mi.Integrator,
    scene: mi.Scene,
    seed: int,
    spp: int,
    sensor: int = 0,
    cpu_time: bool = False,
    **wishes: Any,
) -> Timed:
    """Renders and waits for the image. ``spp`` 0 stands for the number of the scene's sampler;
    ``wishes`` are further arguments of the integrator's ``render()``.

    Raises:
        NotImplementedError: The scene has moving shapes, and the integrator does not support them.
    """
    import drjit as dr
    import mitsuba as mi

    check_all_is_seen(integrator, scene)

    clock = time.process_time if cpu_time else time.perf_counter
    # Free garbage now: the collector must not free it while Dr.Jit traces calls (see garbage.py)
    gc.collect()
    dr.detail.malloc_clear_statistics()
    # Recording the kernel history has no measurable cost
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = clock()
        image = integrator.render(
            scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=True, **wishes
        )
        dr.eval(image)
        dr.sync_thread()
        seconds = clock() - start
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


def plans_for_time(integrator: mi.Integrator, scene: mi.Scene, sensor: int = 0) -> bool:
    """Whether the integrator learns in pilots and plans them for a ``timeout``
    (``rendering/pace.py``).

    The time of such a render does not grow steadily with its samples: with a few more, it begins to
    learn. Often, no number of samples takes a given time.
    """
    view = scene.sensors()[sensor]
    if not (is_staged(integrator) and is_independent(view)):
        return False
    request, spp = Request(scene, view), _more_than_fit(view)
    learns = integrator.plan_learning(request, spp).pilots
    has_sets = integrator.samples_per_set(spp) > 1
    return bool(learns and not has_sets and integrator.pace_stage(request, spp))


def render_for(
    seconds: float, integrator: mi.Integrator, scene: mi.Scene, seed: int, sensor: int = 0
) -> Timed:
    """Renders for ``seconds`` with an integrator for which :func:`plans_for_time` is true, like
    :func:`timed_render` with the parameter ``timeout``."""
    own = integrator.timeout
    timeout = min(own, seconds) if own > 0 else seconds
    spp = _more_than_fit(scene.sensors()[sensor])
    return timed_render(integrator, scene, seed, spp, sensor, timeout=timeout)


def _more_than_fit(sensor: mi.Sensor) -> int:
    """A number of samples per pixel that takes longer than any time limit, about an hour."""
    pixel_count = math.prod(film_extent(sensor.film()))
    return min(_MAX_SPP, max(1 << 20, (1 << 32) // pixel_count))


def own_statistics(integrator: mi.Integrator) -> RenderStatistics | None:
    """The statistics of the last render if the integrator is one of ours; otherwise ``None``."""
    report = getattr(integrator, "statistics", None)
    return report if isinstance(report, RenderStatistics) else None


def samples_for(
    budget: float,
    integrator: mi.Integrator,
    scene: mi.Scene,
    seed: int,
    sensor: int = 0,
    cpu_time: bool = False,
) -> int:
    """The number of samples per pixel that takes ``budget`` seconds.

    Mitsuba's own integrators ignore ``timeout`` except in scalar variants, and most of ours render
    differently with it. Therefore, this function measures the speed and computes the number. It
    doubles the samples until a render takes an eighth of the budget (or four seconds). The last two
    renders give the cost of a sample and the fixed cost of a render.

    If the time more than doubles with the samples, the longer render does something that the
    shorter one does not, such as learning, and the two say nothing about a render in between. This
    function then measures a longer one, or searches for the number of samples between the two.
    """

    def seconds_of(spp: int) -> float:
        arguments = integrator, scene, seed, spp, sensor, cpu_time
        seconds, compiled, *_ = timed_render(*arguments)
        if compiled or seconds < _SHORT_SECONDS:
            seconds = min(seconds, timed_render(*arguments).seconds)
        return seconds

    # Start with 8: with fewer, an integrator may have no pilot pass
    spp = 8
    shorter = seconds_of(spp)
    if shorter > min(budget, 4):
        return max(1, int(budget / shorter * spp))
    while True:
        spp *= 2
        seconds = seconds_of(spp)
        jumps = seconds > _JUMP_RATIO * 2 * shorter
        is_measured = seconds >= min(budget / 8, 4) and not (jumps and seconds < budget / 2)
        if is_measured or spp >= _MAX_SPP:
            break
        shorter = seconds
    if jumps and seconds > budget:
        return _between(seconds_of, spp // 2, spp, budget)
    if jumps:
        return int(budget / seconds * spp)
    # At least half the average: the difference of two noisy times can be close to zero
    per_sample = max((seconds - shorter) / (spp / 2), seconds / spp / 2)
    fixed = max(0.0, seconds - per_sample * spp)
    return min(_MAX_SPP, max(1, int((budget - fixed) / per_sample)))


def _between(seconds_of: Callable[[int], float], fits: int, too_many: int, budget: float) -> int:
    """The largest number of samples that fits into ``budget`` seconds, to within an eighth."""
    while too_many - fits > max(1, fits // 8):
        middle = (fits + too_many) // 2
        if seconds_of(middle) <= budget:
            fits = middle
        else:
            too_many = middle
    return fits
