"""The base class of renders with chains."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ...rendering.camera import film_extent
from ...rendering.pace import StageSamples, TimeLimit
from ...rendering.request import Request
from ...rendering.statistics import PassTimer, RenderStatistics
from ...rendering.turns import let_others, tell
from .chains import Chains, MutationCounts
from .looped import LoopedChains
from .path_chains import PathChains
from .path_target import PathTarget
from .stepped import SteppedChains
from .target import ImageTarget

#: The stream of random numbers of a first stage, not used by the bootstrap and the chains.
FIRST_STAGE = 5


class Stoppable(Protocol):
    """The attribute of the integrator that a render reads."""

    is_cancelled: bool


class ChainRender:
    """A single render. It adds the light of the chains to camera samples that the film must hold.

    Parameters:
        integrator: The integrator, which says whether the render was cancelled.
        target: The target function of the chains.
        request: What the render is asked for; ``spp`` is the number of samples, or mutations, per
            pixel.
        camera_spp: The number of camera samples per pixel in the film.
        statistics: The statistics of the render so far, which are updated.
        start: The start time of the render, by ``time.perf_counter``.
    """

    def __init__(
        self,
        integrator: Stoppable,
        target: ImageTarget,
        request: Request,
        camera_spp: int,
        statistics: RenderStatistics,
        start: float,
    ) -> None:
        self._integrator, self._target = integrator, target
        self._request, self._seed, self._spp = request, request.seed, request.spp
        self._camera_spp = camera_spp
        self._statistics, self._start = statistics, start
        self._film = target.sensor.film()
        width, height = film_extent(self._film)
        self._pixel_count = width * height
        self._counts = {name: 0.0 for name in MutationCounts.__dataclass_fields__}
        self._mutations = 0

    def run(self, interrupt: threading.Event) -> None:
        """Renders, and adds the image to the film even if an exception ends the render."""
        raise NotImplementedError

    @property
    def _kind(self) -> type[Chains]:
        if isinstance(self._target, PathTarget):
            return PathChains
        return SteppedChains if self._target.has_light_paths else LoopedChains

    def _repeat(
        self, count: int, width: int, interrupt: threading.Event, act: Callable[[int], int],
        write: Callable[[], None],
    ) -> bool:  # fmt: skip
        """Calls ``act`` until ``count`` steps, or as many as the time limit allows, have been made.

        Parameters:
            width: The number of lanes of a step.
            act: A function of the maximum number of steps that returns the number it made.
            write: Adds the image of the steps so far to the film.

        Returns:
            False if the render was interrupted or cancelled before the end.
        """
        request, done = self._request, 0
        steps = StageSamples(TimeLimit(request.timeout, self._start, width), count)
        while done < steps.samples:
            let_others()
            if interrupt.is_set() or self._integrator.is_cancelled:
                return False
            timer = PassTimer()
            made = act(min(steps.longest, steps.samples - done))
            done += made
            dr.sync_thread()
            if not timer.has_new_kernels:
                steps.passed(made, done, timer.seconds)
            self._statistics.passes += 1
            self._show(write, round(done * width / self._pixel_count))
            if request.progress is not None:
                tell(request.progress, min(1.0, done / steps.samples))
        return True

    def _show(self, write: Callable[[], None], spp: int) -> None:
        """Shows the image so far, if somebody watches and wants to see it now."""
        watch, film = self._request.watch, self._film
        if watch is not None and watch.is_due():
            of_camera = film.develop(raw=True)
            write()
            watch.show(film, spp, self._statistics)
            film.clear()
            film.put_block(mi.ImageBlock(of_camera, offset=film.crop_offset()))

    def _count(self, counts: MutationCounts, mutations: int) -> None:
        longest = float(dr.max(counts.longest)[0])
        self._counts["longest"] = max(self._counts["longest"], longest)
        for name in self._counts:
            if name != "longest":
                self._counts[name] += float(dr.sum(mi.Float64(getattr(counts, name)))[0])
        self._mutations += mutations

    def _report(self, samples: int) -> None:
        """Updates the statistics after ``samples`` samples per pixel."""
        counts, statistics = self._counts, self._statistics
        statistics.rays["camera"] += self._mutations
        statistics.rays["scatter"] += int(counts["scatter"])
        statistics.rays["shadow"] += int(counts["shadow"])
        statistics.connections += int(counts["connections"])
        statistics.zero_radiance = counts["black"] / max(1, self._mutations)
        statistics.spp = samples

    def _rates(self) -> str:
        counts = self._counts
        small = _percent(counts["accepted_small"], self._mutations - counts["large"])
        if not counts["large"]:
            return f"accepted: {small} of small steps"
        large = _percent(counts["accepted_large"], counts["large"])
        return f"accepted: {large} of large steps, {small} of small steps"


def _percent(part: float, whole: float) -> str:
    return f"{part / whole:.1%}" if whole else "none"
