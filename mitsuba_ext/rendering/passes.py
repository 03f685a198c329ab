"""The passes of a render: from the seed of the sampler to the block of the film.

All passes of a stage run the same kernel, which is recorded where it can be (``frozen.py``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.estimator import CameraRays, Sample
from ..util.arrays import from_numpy
from . import camera
from .device import device_of, look_again
from .filter_weights import put_splats
from .mask_samples import MaskSamples
from .pass_samples import GradientsError, count_rays, look, put_samples, recorded
from .plan import plan_render
from .request import Request
from .staged import Staged
from .stages import Stage
from .statistics import PassTimer, RenderStatistics


class Passes:
    """Takes the samples of one render, in passes, and puts them into a block.

    Raises:
        NotImplementedError: The integrator has AOVs, and the film is a special one.
    """

    #: Whether a whole pass may be recorded (``frozen.py``). False if a subclass reads the samples.
    freezes_passes = True

    def __init__(self, integrator: Staged, request: Request) -> None:
        self.integrator, self.request = integrator, request
        self.scene, self.sensor, self.film = request.scene, request.sensor, request.sensor.film()
        self.sampler = camera.own_sampler(self.sensor)
        look_again()
        self.plan = plan_render(integrator, request, self.sampler, device_of(mi.Float))
        self.statistics = integrator.statistics = RenderStatistics()
        self.tally = dr.zeros(mi.UInt64, 4)
        aovs = integrator.aov_names()
        if aovs and mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{integrator.name}": the film "{self.film.class_name()}" has no room for more '
                f'channels ("aovs", "count_samples"): use an "hdrfilm".'
            )
        self.film.prepare(aovs)
        self._has_ray_aovs = integrator.has_ray_aovs
        self.masks = None
        if integrator.masks:
            self.masks = MaskSamples(
                integrator.name, self.scene, self.film, integrator.masks, integrator.hide_emitters
            )
        # A single part has no range, so that kernels need not add its first pixel
        self.parts = [None] if self.plan.parts == 1 else self.plan.pixels
        # Structured samplers, one for each part of the film, which keep their state between passes
        self.samplers: list[mi.Sampler] = []
        if self.plan.structured:
            self.samplers = [self.sampler, *(self.sampler.clone() for _ in self.parts[1:])]
            for index, sampler in enumerate(self.samplers):
                sampler.set_samples_per_wavefront(self.plan.limit)
                self._seed(sampler, index, self.plan.limit, self.parts[index])
        self.block, self.splats = self.film.create_block(), None
        # One kernel for all passes: coalescing is decided once
        self.block.set_coalesce(self.block.coalesce() and self.plan.longest_pass >= 4)
        # Samples per pixel that are not part of the image, and the sum of the weights of the others
        self.forgotten, self.weight = 0, 0.0

    def run_pass(self, stage: Stage, spp: int) -> bool:
        """Renders ``spp`` samples per pixel into the block. Returns True if it compiled a
        kernel."""
        timer = PassTimer()
        for part in range(len(self.parts)):
            self._run_part(stage, spp, part)
        self._add_tracing(timer)
        dr.sync_thread()

        self.statistics.passes += 1
        self.statistics.spp += spp
        self.weight += stage.weight * spp
        self.statistics.rays["camera"] += self._lanes(spp)
        return timer.has_new_kernels

    def _add_tracing(self, timer: PassTimer) -> None:
        self.statistics.add_tracing(timer.seconds, timer.has_compiled)

    def _run_part(self, stage: Stage, spp: int, part: int) -> None:
        sampler, pixels = self._part_sampler(spp, part), self.parts[part]
        lanes = camera.PassLanes.of(self.film, spp, self.statistics.spp, pixels)
        if not self._is_frozen(stage):
            if self._is_walk_frozen(stage) and stage.observer is None:
                stage = replace(stage, estimator=recorded(stage.estimator))
            self._take(stage, sampler, lanes.lanes(self.film))
            return
        self._begin(stage, lanes)
        weight = dr.opaque(mi.Float, stage.weight)  # stages of different weights share a kernel
        labelled = put_samples(
            stage.estimator, stage.camera, self.scene, self.sensor, sampler, lanes,
            self.plan.spp, weight, self.block, self.tally, self.masks and self.masks.labels,
        )  # fmt: skip
        if labelled is not None:
            self.masks.taken.append(labelled)
        self._finish_take(sampler)

    def _run_scout(self, stage: Stage) -> None:
        timer = PassTimer()
        for pixels in self.parts if stage.pixels is None else [stage.pixels]:
            self._scout(stage, pixels)
        self._add_tracing(timer)
        dr.sync_thread()

    def _scout(self, stage: Stage, pixels: range | np.ndarray | None) -> None:
        sampler = mi.load_dict({"type": "independent"})
        # The same numbers for all seeds: the decisions of a scout change sizes of tables, and with
        # them the kernels. Images of different seeds are independent: none of these samples is a
        # part of them
        number = 0 if stage.pixels is not None or pixels is None else pixels.start
        sampler.seed(dr.opaque(mi.UInt32, number), self._lanes(1, pixels))
        if stage.pixels is None:
            lanes = camera.PassLanes.of(self.film, 1, 0, pixels)
        else:
            lanes = camera.PixelLanes(from_numpy(mi.UInt32, pixels))
        self._begin(stage, lanes)
        if self._is_frozen(stage):
            radiance = look(
                stage.estimator, stage.camera, self.scene, self.sensor, sampler, lanes,
                self.plan.spp,
            )  # fmt: skip
        else:
            rays = self._rays(stage, sampler, lanes.lanes(self.film))
            radiance = stage.estimator(self.scene, sampler, rays, mi.Bool(True)).L
        dr.eval(radiance)

    def _begin(self, stage: Stage, lanes: camera.PassLanes) -> None:
        """Tells the observer of a stage, if there is one, the pixels of the next samples."""
        if stage.observer is not None:
            pixel = lanes.lanes(self.film).pixel
            dr.eval(pixel)
            stage.observer.begin(lanes.count, pixel)

    def _is_frozen(self, stage: Stage) -> bool:
        """Whether the passes of this stage are recorded (``frozen.py``)."""
        return not self._has_ray_aovs and self._is_walk_frozen(stage)

    def _is_walk_frozen(self, stage: Stage) -> bool:
        """Whether the estimator of this stage is recorded, if not the whole pass."""
        if not self.freezes_passes:
            return False
        if stage.observer is not None and not stage.observer.can_be_frozen:
            return False
        # Special films may run any code when they prepare samples
        is_special = mi.has_flag(self.film.flags(), mi.FilmFlags.Special)
        return not is_special and getattr(stage.estimator, "can_be_frozen", False)

    def _take(self, stage: Stage, sampler: mi.Sampler, lanes: camera.Lanes) -> None:
        """Puts the samples of these lanes into the block."""
        rays = self._rays(stage, sampler, lanes)
        count = dr.opaque(mi.Float, stage.weight)
        sample = self._sample(stage, sampler, rays, count)
        for splats in sample.splats:
            if self.splats is None:
                self.splats = self.film.create_block()
                self.splats.set_coalesce(False)
            camera.put_splats(self.film, self.splats, splats, count)
        self._finish_take(sampler)

    def _rays(self, stage: Stage, sampler: mi.Sampler, lanes: camera.Lanes) -> CameraRays:
        numbers = camera.draw_numbers(self.sensor, sampler, lanes, stage.camera)
        return camera.camera_rays(self.sensor, lanes, numbers, self.plan.spp)

    def _sample(
        self, stage: Stage, sampler: mi.Sampler, rays: CameraRays, count: mi.Float | float = 1.0
    ) -> Sample:
        """Puts the samples of these rays, without their splats, into the block."""
        if self.masks is not None:
            # Before the samples of the image: a BSDF that is asked for its transmission may read
            # an array on the host, which evaluates the samples in the block so far
            self.masks.taken.append(self.masks.labels.of(self.scene, rays, count))
        if stage.observer is not None:
            stage.observer.begin(dr.width(rays.ray), rays.pixel)
        sample = stage.estimator(self.scene, sampler, rays, mi.Bool(True))
        if dr.grad_enabled(sample.L):
            raise GradientsError
        aovs = sample.aovs
        if self._has_ray_aovs:
            aovs = aovs + self.integrator.sample_aovs(self.scene, sampler, rays.ray)
        camera.put(self.film, self.block, rays, sample, aovs, count)
        count_rays(self.tally, sample)
        return sample

    def _finish_take(self, sampler: mi.Sampler) -> None:
        if self.plan.structured:
            sampler.advance()
            sampler.schedule_state()
        self._evaluate(self.splats and self.splats.tensor())

    def _evaluate(self, *others: Any) -> None:
        """Evaluates the samples of a pass, and ``others`` in the same kernel."""
        dr.eval(self.block.tensor(), self.tally, *others, self.masks and self.masks.taken)
        if self.masks is not None:
            self.masks.put()

    def _part_sampler(self, spp: int, part: int) -> mi.Sampler:
        if self.plan.structured:
            return self.samplers[part]
        sampler = self.sampler.clone()
        index = self.statistics.passes * len(self.parts) + part
        self._seed(sampler, index, spp, self.parts[part])
        return sampler

    def _seed(
        self, sampler: mi.Sampler, index: int, spp: int, pixels: range | np.ndarray | None
    ) -> None:
        """Seeds a sampler for part ``index``, counted over all passes. The first one is seeded as
        in Mitsuba's own integrators, so that it draws the same numbers."""
        seed = mi.UInt32(self.request.seed)
        if index > 0:
            seed = mi.sample_tea_32(seed, mi.UInt32(index))[0]
        dr.make_opaque(seed)
        camera.tell_film(sampler, self.film, getattr(pixels, "start", 0))
        sampler.seed(seed, self._lanes(spp, pixels))

    def _lanes(self, spp: int, pixels: range | np.ndarray | None = None) -> int:
        return (self.plan.pixel_count if pixels is None else len(pixels)) * spp

    def forget(self) -> None:
        """Removes all samples so far from the image."""
        self.forgotten, self.weight = self.statistics.spp, 0.0
        self.block.clear()
        self.splats = None
        if self.masks is not None:
            self.masks.clear()

    def fill_film(self) -> None:
        """Adds the samples of the finished passes to the film."""
        self.film.put_block(self.block)
        if self.splats is not None and self.statistics.spp > 0:
            tensor, offset = self.splats.tensor(), self.splats.offset()
            put_splats(self.film, tensor, offset, self.weight)
