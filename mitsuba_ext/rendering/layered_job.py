"""A render from the middle of a lens, in layers that a filter blurs."""

from __future__ import annotations

import math

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
from .pinhole import PinholeView, Surface
from .render import Job

#: Edge of the squares of pixels for which it is decided together whether anything hidden is needed.
_TILE = 8

#: Where the blurs of neighbouring pixels differ by more, in pixels, one hides something behind it.
_EDGE = 0.5

#: What lies around the film is blurred into it. So far outside samples are taken at most: this
#: share of the film's longer edge.
_WIDEST_MARGIN = 1 / 8

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
        limits = self.filter.limits(self.blurs.ravel())
        self.layers = LayerBlocks(self.film, self.size, offset, limits, integrator.denoise)
        self._last_stage = None

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

    def _sample(self, stage, sampler, rays: CameraRays, count=1.0) -> Sample:
        sample = super()._sample(stage, sampler, rays, count)
        first = self.view.first(rays.ray)
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
        if self._stopped(interrupt):
            return
        outside = np.ones_like(self.blurs, dtype=bool)
        outside[self._inside] = False
        self._run_pixels(outside, None, interrupt)
        if self.filter.has_layers:
            least = least_blur_around(self.blurs, self.lens.blur_of_sky)
            self._run_pixels(np.isfinite(least), mi.Float(least.ravel()), interrupt)

    # ---- What the film does not show ----

    def _run_pixels(self, chosen: np.ndarray, least: mi.Float | None, interrupt) -> None:
        """Takes samples of some pixels: of what is seen first, or where ``least`` is given, of what
        is hidden by something whose blur is larger than that by more than 1."""
        spp = self.integrator.hidden_samples(self.statistics.spp)
        pixels = np.flatnonzero(chosen).astype(np.uint32)
        most = min(_MOST_LANES // self.integrator.sample_cost, self.integrator.most_lanes)
        per_pass = max(1, most // spp)
        for start in range(0, len(pixels), per_pass):
            if self._stopped(interrupt):
                return
            part = pixels[start : start + per_pass]
            # Numbers that no other part of the render has
            number = (2 if least is None else 3) * 0x40000000 + start
            seed = mi.sample_tea_32(mi.UInt32(self.plan.seed), mi.UInt32(number & 0xFFFFFFFF))[0]
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(dr.opaque(mi.UInt32, seed[0]), len(part) * spp)
            self._run_some_pixels(mi.UInt32(part), spp, sampler, least)
            dr.eval(self.layers.tensors())
            dr.sync_thread()

    def _run_some_pixels(self, pixels, spp, sampler, least) -> None:
        stage = self._last_stage
        lane = dr.arange(mi.UInt32, len(pixels) * spp)
        place = lane // dr.opaque(mi.UInt32, spp)
        pixel = dr.gather(mi.UInt32, pixels, place)
        lanes = self._lanes_with_margin(pixel, lane - place * dr.opaque(mi.UInt32, spp))
        numbers = camera.draw_numbers(self.sensor, sampler, lanes, stage.camera)
        rays = camera.camera_rays(self.sensor, lanes, numbers, self.plan.spp)
        first = self.view.first(rays.ray)
        weight = mi.Float(rays.weight) * dr.opaque(mi.Float, self.statistics.spp / spp)
        if least is None:
            sample = stage.estimator(self.scene, sampler, rays, mi.Bool(True))
            self._put(rays, sample, first, weight, mi.Bool(True))
            return
        rest, hidden, active = self.view.beyond(rays.ray, first)
        active &= first.blur > dr.gather(mi.Float, least, pixel) + 1
        if not self._sees_sky:
            active &= hidden.is_hit
        rays.ray.o = rest.o
        sample = stage.estimator(self.scene, sampler, rays, active)
        self._put(rays, sample, hidden, weight, active, first.blur)

    def _lanes_with_margin(self, pixel: mi.UInt32, index: mi.UInt32) -> camera.Lanes:
        """Lanes for pixels of the film and its margin. Tables of the nested integrator that have an
        entry for each pixel of the film know the nearest one."""
        width = dr.opaque(mi.UInt32, self.size.width)
        y = pixel // width
        corner = mi.Vector2i(mi.Int32(pixel - y * width), mi.Int32(y)) - self.margin
        border = self.film.rfilter().border_size() if self.film.sample_border() else 0
        extent = camera.film_extent(self.film)
        inside = dr.clip(corner + border, 0, mi.Vector2i(extent[0] - 1, extent[1] - 1))
        known = mi.UInt32(inside.y * extent[0] + inside.x)
        return camera.Lanes(known, corner + mi.Vector2i(self.film.crop_offset()), index)

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


def least_blur_around(blurs: np.ndarray, sky: float) -> np.ndarray:
    """By pixel, the least blur (that of the farthest thing) at an edge which is so near that the
    lens may see that thing behind the pixel; infinity where there is no such edge. Decided for
    tiles of pixels together.

    Parameters:
        blurs: Signed radii in pixels, [y, x].
        sky: That of infinity.
    """
    height, width = blurs.shape
    edge = np.full_like(blurs, np.inf)
    for axis in range(2):
        a = np.moveaxis(blurs, axis, 0)
        e = np.moveaxis(edge, axis, 0)
        jump = np.abs(a[1:] - a[:-1]) > _EDGE
        least = np.where(jump, np.minimum(a[1:], a[:-1]), np.inf)
        e[1:] = np.minimum(e[1:], least)
        e[:-1] = np.minimum(e[:-1], least)
    tiles = -(-height // _TILE), -(-width // _TILE)
    pad = ((0, tiles[0] * _TILE - height), (0, tiles[1] * _TILE - width))

    def by_tile(image: np.ndarray, fill: float, reduce) -> np.ndarray:
        padded = np.pad(image, pad, constant_values=fill)
        return reduce(padded.reshape(tiles[0], _TILE, tiles[1], _TILE), axis=(1, 3))

    least, most = by_tile(edge, np.inf, np.min), by_tile(blurs, -np.inf, np.max)
    # A ray through the edge of the lens is so far away from where the middle sees it
    reach = np.ceil((most - sky) / _TILE)
    found = np.full_like(least, np.inf)
    for radius in range(int(reach.max()) + 1):
        found = np.where(reach >= radius, least, found)
        padded = np.pad(least, 1, mode="edge")
        least = np.minimum.reduce([
            padded[y : y + tiles[0], x : x + tiles[1]] for y in range(3) for x in range(3)
        ])  # fmt: skip
    found[most <= found + 1] = np.inf
    return np.repeat(np.repeat(found, _TILE, 0), _TILE, 1)[:height, :width]
