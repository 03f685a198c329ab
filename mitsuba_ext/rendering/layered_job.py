"""A render from the middle of a lens, in layers that a filter blurs."""

from __future__ import annotations

import math
import time

import drjit as dr
import mitsuba as mi
import numpy as np

from ..defocus.denoised import denoised
from ..defocus.filters import Capture, make_filter
from ..defocus.images import Size
from ..defocus.layers import LayerSums
from ..transport.colour import to_rgb
from ..transport.estimator import CameraRays, Sample
from ..transport.lens_view import LensView
from . import camera
from .layer_blocks import LayerBlocks
from .layer_samples import least_blur_around, outside_pixels, relative_counts, whole_counts
from .pinhole import PinholeView, Surface
from .render import Job

#: What lies around the film is blurred into it. So far outside samples are taken at most: this
#: share of the film's longer edge.
_WIDEST_MARGIN = 1 / 8

#: This share of the samples is the same for all pixels of the film.
_EQUAL_SHARE = 1 / 4

#: Marks pixels in a list of which hidden things are wanted.
_HIDDEN = 0x80000000

#: Samples of a pass over a list of pixels, at most.
_MOST_LANES = 1 << 21


class LayeredJob(Job):
    """One render of :class:`~mitsuba_ext.integrators.ecoc_dof`.

    The samples of the stages are those of the nested integrator along rays from the middle of the
    lens. Then ``integrator.hidden_samples`` for each pixel are taken of what these surfaces hide,
    where the lens sees a part of it, and of what lies around the film. A filter makes the picture.
    """

    def __init__(self, integrator, scene, sensor, seed, spp) -> None:
        super().__init__(integrator, scene, sensor, seed, spp)
        if mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{integrator.name}": does not work with the film "{self.film.class_name()}": '
                f'use an "hdrfilm".'
            )
        self.lens = integrator.thin_lens(sensor)
        self._lens_view = LensView(scene, sensor, integrator.scene_query(scene))
        self.view = PinholeView(self._lens_view, scene, self.lens, integrator.denoise)
        self.filter = make_filter(integrator.filter)
        self._crop = [int(n) for n in self.film.crop_size()]
        # The film and a margin around it
        self.margin = math.ceil(_WIDEST_MARGIN * max(self._crop))
        self.size = self._with_margin()
        self.blurs = self._blurs()
        self._trim()
        offset = [int(n) - self.margin for n in self.film.crop_offset()]
        # A closed room has nothing behind its walls
        self._sees_sky = bool((self.blurs == np.float32(self.lens.blur_of_sky)).any())
        self._plan_samples()
        limits = self.filter.limits(self.blurs.ravel())
        self.layers = LayerBlocks(self.film, self.size, offset, limits, integrator.denoise)
        self._last_stage = None

    def _plan_samples(self) -> None:
        """How many samples each pixel of the film takes, and how many of them all take."""
        plan, spp = self.plan, self.plan.spp
        self._equal_spp = max(sum(plan.stages[:-1]), math.ceil(_EQUAL_SHARE * spp))
        # Stratified samples are the same for all pixels, and so is what fits into a time
        is_fixed = plan.structured or self.budget.is_limited or self.film.sample_border()
        if is_fixed or self._equal_spp >= spp:
            self._equal_spp = spp
        self.counts = np.full(self.blurs[self._inside].shape, spp, np.uint32)
        if self._equal_spp < spp:
            share = relative_counts(self.blurs[self._inside], self._equal_spp / spp)
            self.counts = np.maximum(whole_counts(spp * share), self._equal_spp)
        # All samples of a pixel count the same, and together as those of any other pixel
        self._weights = mi.Float((spp / self.counts).astype(np.float32).ravel())

    def _with_margin(self) -> Size:
        return Size(*(n + 2 * self.margin for n in self._crop))

    def _blurs(self) -> np.ndarray:
        """The blur at the middle of each pixel: [y, x]."""
        _index, pixel = self.size.pixels()
        position = (mi.Point2f(pixel) + 0.5 - self.margin) / mi.Vector2f(self._crop)
        time = self.sensor.shutter_open() + 0.5 * self.sensor.shutter_open_time()
        ray = self._lens_view.ray(position, 0.5, time)
        return self.view.first(ray).blur.numpy().reshape(self.size.height, self.size.width)

    def _trim(self) -> None:
        """Leaves as much of the margin as the largest blur reaches."""
        margin, film = self.margin, self.blurs[self._inside]
        self.margin = min(margin, math.ceil(np.abs(film).max()) + 1)
        cut = margin - self.margin
        height, width = self.blurs.shape
        self.blurs = np.ascontiguousarray(self.blurs[cut : height - cut, cut : width - cut])
        self.size = self._with_margin()

    @property
    def _inside(self) -> tuple[slice, slice]:
        """The pixels of the film among those with the margin."""
        width, height = self._crop
        m = self.margin
        return slice(m, m + height), slice(m, m + width)

    def _run_stage(self, stage, samples, is_last, interrupt) -> None:
        if is_last and self._equal_spp < self.plan.spp:
            samples, is_last = self._equal_spp - self.statistics.spp, False
        super()._run_stage(stage, samples, is_last, interrupt)

    def _sample(self, stage, sampler, rays: CameraRays, count=1.0) -> Sample:
        # Before the samples are put into the block: null transmission of textures evaluates
        # something while it is traced, and with it what waits for the block, in another kernel
        first = self.view.first(rays.ray)
        if self._equal_spp < self.plan.spp:
            count = count * dr.gather(mi.Float, self._weights, rays.pixel)
        sample = super()._sample(stage, sampler, rays, count)
        self._put(rays, sample, first, mi.Float(rays.weight * count), mi.Bool(True))
        self._last_stage = stage
        return sample

    def _run_part(self, stage, spp, part) -> None:
        super()._run_part(stage, spp, part)
        dr.eval(self.layers.tensors())

    def _put(
        self, rays, sample, surface: Surface, weight, active, behind: mi.Float | None = None
    ) -> None:
        L = to_rgb(sample.L * rays.importance, rays.ray.wavelengths)
        alpha = dr.select(sample.valid, mi.Float(1), 0)
        self.layers.put(rays.position, mi.Color3f(L), alpha, surface, weight, active, behind)

    def run(self, interrupt) -> None:
        super().run(interrupt)
        if not self._stopped(interrupt):
            self._run_lists(interrupt)

    # ---- What not all pixels of the film take ----

    def _run_lists(self, interrupt) -> None:
        """Takes the rest of the film's samples; and those of what lies around the film, and of what
        is hidden by something whose blur is larger by more than 1 than that of the farthest thing
        around."""
        # With a timeout, these are fewer
        spp = self.plan.spp if self._equal_spp < self.plan.spp else self.statistics.spp
        shape = self.blurs.shape
        besides = self.integrator.hidden_samples(spp)
        seen, hidden = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
        seen[outside_pixels(self.blurs, self.margin)] = besides
        weight = np.full(shape, spp / besides, np.float32)
        if self._equal_spp < spp:
            seen[self._inside] = self.counts - self._equal_spp
            weight[self._inside] = spp / self.counts
        self._table = mi.Float(weight.ravel())
        self._hidden_weight = dr.opaque(mi.Float, spp / besides)
        if self.filter.has_layers:
            least = least_blur_around(self.blurs, self.lens.blur_of_sky)
            hidden[np.isfinite(least)] = besides
            self._least = mi.Float(least.ravel())
        # Neighbouring lanes are alike: first what is seen, then what is hidden
        pixels = np.arange(seen.size, dtype=np.uint32)
        lanes = np.concatenate([
            np.repeat(pixels, seen.ravel()), np.repeat(pixels | _HIDDEN, hidden.ravel())
        ])  # fmt: skip
        most = min(_MOST_LANES // self.integrator.sample_cost, self.integrator.most_lanes)
        for part in np.array_split(lanes, -(-len(lanes) // max(1, most))) if len(lanes) else ():
            if self._stopped(interrupt):
                return
            self._run_list(part)
        self.statistics.spp, self.statistics.interrupted = spp, False
        if self.integrator.progress is not None:
            self.integrator.progress(1.0)

    def _run_list(self, part: np.ndarray) -> None:
        begin, stage = time.perf_counter(), self._last_stage
        sampler = mi.load_dict({"type": "independent"})
        # Numbers that no other part of the render has
        number = (0x80000000 + self.statistics.passes) & 0xFFFFFFFF
        seed = mi.sample_tea_32(mi.UInt32(self.plan.seed), mi.UInt32(number))[0]
        sampler.seed(dr.opaque(mi.UInt32, seed[0]), len(part))
        lane = mi.UInt32(part)
        pixel, is_hidden = lane & (_HIDDEN - 1), lane >= _HIDDEN
        lanes, is_film = self._lanes_with_margin(pixel)
        numbers = camera.draw_numbers(self.sensor, sampler, lanes, stage.camera)
        rays = camera.camera_rays(self.sensor, lanes, numbers, self.plan.spp)
        surface, active, behind = self._surface(rays, pixel, is_hidden)
        sample = stage.estimator(self.scene, sampler, rays, active)
        count = dr.select(
            is_hidden, self._hidden_weight, dr.gather(mi.Float, self._table, pixel)
        )
        self._put_into_film(sampler, rays, sample, dr.select(is_film & ~is_hidden, count, 0))
        self._put(rays, sample, surface, mi.Float(rays.weight * count), active, behind)
        self.statistics.compile_seconds += time.perf_counter() - begin
        dr.eval(self.block.tensor(), self.layers.tensors(), self.tally)
        dr.sync_thread()
        self.statistics.passes += 1
        self.statistics.rays["camera"] += len(part)

    def _surface(
        self, rays: CameraRays, pixel: mi.UInt32, is_hidden: mi.Bool
    ) -> tuple[Surface, mi.Bool, mi.Float | None]:
        """What a ray meets, or meets behind that where ``is_hidden``: from there on the ray goes.
        And where there is something, and the blur of what hides it (infinite for nothing)."""
        first = self.view.first(rays.ray)
        if not self.filter.has_layers:
            return first, mi.Bool(True), None
        rest, hidden, active = self.view.beyond(rays.ray, first, is_hidden)
        active &= first.blur > dr.gather(mi.Float, self._least, pixel) + 1
        if not self._sees_sky:
            active &= hidden.is_hit
        rays.ray.o = dr.select(is_hidden, rest.o, rays.ray.o)
        behind = dr.select(is_hidden, first.blur, dr.inf)
        return dr.select(is_hidden, hidden, first), active | ~is_hidden, behind

    def _lanes_with_margin(self, pixel: mi.UInt32) -> tuple[camera.Lanes, mi.Bool]:
        """Lanes for pixels of the film and its margin, and which of them are in the film. Tables of
        the nested integrator that have an entry for each pixel of the film know the nearest one."""
        corner = self.size.position(pixel) - self.margin
        border = self.film.rfilter().border_size() if self.film.sample_border() else 0
        extent = camera.film_extent(self.film)
        inside = dr.clip(corner + border, 0, mi.Vector2i(extent[0] - 1, extent[1] - 1))
        known = mi.UInt32(inside.y * extent[0] + inside.x)
        is_film = dr.all((corner >= 0) & (corner < mi.Vector2i(self._crop)))
        index = dr.zeros(mi.UInt32, dr.width(pixel))
        return camera.Lanes(known, corner + mi.Vector2i(self.film.crop_offset()), index), is_film

    # ---- The picture ----

    def fill_film(self) -> None:
        if self.statistics.spp > 0:
            self._put_picture()
        super().fill_film()

    def _put_picture(self) -> None:
        """Replaces colours and alpha of the block by those of the blurred layers."""
        sums, alphas = self.layers.sums()
        if self.integrator.denoise:
            sums = [denoised(layer, self.size) for layer in sums]
        values = np.array(self.block.tensor())
        has_alpha = mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha)
        # The film divides by these
        weight = values[..., 4 if has_alpha else 3]
        values[..., :3] = self._picture(sums) * weight[..., None]
        if has_alpha:
            for layer, alpha in zip(sums, alphas):
                layer.color = mi.Color3f(alpha)
            values[..., 3] = self._picture(sums)[..., 0] * weight
        offset = self.block.offset()
        self.block = mi.ImageBlock(mi.TensorXf(values), offset=offset)

    def _picture(self, sums: list[LayerSums]) -> np.ndarray:
        capture = Capture(self.size, sums, mi.Float(self.blurs.ravel()))
        picture = self.filter.picture(capture)
        shape = (self.size.height, self.size.width, 3)
        return mi.TensorXf(dr.ravel(picture), shape=shape).numpy()[self._inside]
