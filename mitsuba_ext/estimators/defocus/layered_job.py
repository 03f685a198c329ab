"""Defocus by layers: a render from the centre of the lens, whose layers a filter blurs."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...rendering import camera
from ...rendering.device import device_of
from ...rendering.render import Job
from ...rendering.request import Request
from ...transport.estimator import CameraRays, Sample
from ...transport.lens_view import LensView
from ...util.arrays import from_numpy
from ...util.spectra import to_rgb
from .denoised import denoised
from .filters import FILTERS, Capture
from .images import Size
from .layer_blocks import LayerBlocks
from .layer_samples import distance_from_film, least_blur_around, outside_pixels
from .layers import LayerSums
from .pinhole import PinholeView, Surface

#: The maximum width of the margin in which samples are taken of surfaces outside the film that are
#: blurred into it, in units of the film's longer edge. Everything beyond is assumed to look like
#: the edge of the margin. With 1/8, corners are wrong with wide lenses; 1/2 costs 1.7 times as much
#: and gains little.
_MAX_MARGIN = 1 / 4

#: The bit that marks the pixels in a list whose hidden surfaces are sampled.
_HIDDEN_BIT = 0x80000000


class LayeredJob(Job):
    """A render by :class:`~mitsuba_ext.integrators.ecoc_dof`.

    The stages take samples of the nested integrator along rays from the centre of the lens. Then,
    ``integrator.hidden_samples`` samples per pixel are taken of hidden surfaces, where the lens
    sees part of them, and of surfaces outside the film. A filter computes the image.
    """

    #: The samples are also put into layers.
    freezes_passes = False

    def __init__(self, integrator, request: Request) -> None:
        super().__init__(integrator, request)
        if mi.has_flag(self.film.flags(), mi.FilmFlags.Special):
            raise NotImplementedError(
                f'"{integrator.name}": does not work with the film "{self.film.class_name()}": '
                f'use an "hdrfilm".'
            )
        self.lens = integrator.thin_lens(self.sensor)
        self._lens_view = LensView(
            self.scene, self.sensor, integrator.scene_query(self.scene)
        )
        self.view = PinholeView(
            self._lens_view, self.scene, self.lens, integrator.denoise
        )
        self.filter = FILTERS[integrator.filter]()
        self._crop = [int(n) for n in self.film.crop_size()]
        # The film and a margin around it
        self.margin = math.ceil(_MAX_MARGIN * max(self._crop))
        self.size = self._with_margin()
        self.blurs = self._blurs()
        self._trim()
        offset = [int(n) - self.margin for n in self.film.crop_offset()]
        # If the sky is not visible, the scene may be a closed room, with nothing behind its walls
        self._sees_sky = bool((self.blurs == np.float32(self.lens.blur_of_sky)).any())
        limits = self.filter.limits(self.blurs.ravel())
        self.layers = LayerBlocks(self.film, self.size, offset, limits, integrator.denoise)
        self._last_stage = None

    def _with_margin(self) -> Size:
        return Size(*(n + 2 * self.margin for n in self._crop))

    def _blurs(self) -> np.ndarray:
        """The blur at the middle of each pixel, [height, width]."""
        _index, pixel = self.size.pixels()
        position = (mi.Point2f(pixel) + 0.5 - self.margin) / mi.Vector2f(self._crop)
        time = self.sensor.shutter_open() + 0.5 * self.sensor.shutter_open_time()
        ray = self._lens_view.ray(position, 0.5, time)
        return self.view.first(ray).blur.numpy().reshape(self.size.height, self.size.width)

    def _trim(self) -> None:
        """Reduces the margin to the width that is blurred into the film or into which the film is
        blurred."""
        margin, film = self.margin, self.blurs[self._inside]
        distance = distance_from_film(self.blurs.shape, margin)
        inwards = distance[np.abs(self.blurs) >= distance].max()
        self.margin = min(margin, math.ceil(max(np.abs(film).max(), inwards)) + 1)
        cut = margin - self.margin
        height, width = self.blurs.shape
        self.blurs = np.ascontiguousarray(self.blurs[cut : height - cut, cut : width - cut])
        self.size = self._with_margin()

    @property
    def _inside(self) -> tuple[slice, slice]:
        """The film, as slices of arrays that include the margin."""
        width, height = self._crop
        m = self.margin
        return slice(m, m + height), slice(m, m + width)

    def _sample(self, stage, sampler, rays: CameraRays, count=1.0) -> Sample:
        # Before samples are added to the block: tracing the null transmission of textures evaluates
        # arrays, which would also evaluate the pending samples, in another kernel
        first = self.view.first(rays.ray)
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
            self._run_besides(interrupt)

    # ---- Surfaces that are hidden or outside the film ----

    def _run_besides(self, interrupt) -> None:
        """Takes samples of surfaces outside the film, and of hidden surfaces: where the blur of the
        front surface exceeds the blur of the farthest surface around by more than 1."""
        count = self.integrator.hidden_samples(self.statistics.spp)
        self._weight = dr.opaque(mi.Float, self.statistics.spp / count)
        pixels = np.flatnonzero(outside_pixels(self.blurs, self.margin)).astype(np.uint32)
        if self.filter.has_layers:
            least = least_blur_around(self.blurs, self.lens.blur_of_sky)
            self._least = from_numpy(mi.Float, least)
            hidden = np.flatnonzero(np.isfinite(least)).astype(np.uint32)
            pixels = np.concatenate([pixels, hidden | _HIDDEN_BIT])
        if len(pixels) == 0:
            return
        # Passes of about equal length; neighbouring lanes have neighbouring pixels
        samples = device_of(mi.Float).pass_samples // self.integrator.sample_cost
        most = min(samples, self.plan.most_lanes)
        passes = -(-len(pixels) // max(1, most // count))
        for number, part in enumerate(np.array_split(pixels, passes)):
            if self._stopped(interrupt):
                return
            self._run_list(mi.UInt32(part), count, number)

    def _run_list(self, pixels: mi.UInt32, count: int, number: int) -> None:
        """Takes ``count`` samples of each of these pixels."""
        stage = self._last_stage
        lane = dr.arange(mi.UInt32, len(pixels) * count)
        place = lane // dr.opaque(mi.UInt32, count)
        sampler = mi.load_dict({"type": "independent"})
        # A seed that no other part of the render uses
        seed = mi.sample_tea_32(mi.UInt32(self.request.seed), mi.UInt32(0x80000000 + number))[0]
        sampler.seed(dr.opaque(mi.UInt32, seed[0]), len(lane))
        chosen = dr.gather(mi.UInt32, pixels, place)
        pixel, is_hidden = chosen & (_HIDDEN_BIT - 1), chosen >= _HIDDEN_BIT
        lanes = self._lanes_with_margin(pixel, lane - place * dr.opaque(mi.UInt32, count))
        rays = self._rays(stage, sampler, lanes)
        surface, active, behind = self._surface(rays, pixel, is_hidden)
        sample = stage.estimator(self.scene, sampler, rays, active)
        self._put(rays, sample, surface, mi.Float(rays.weight) * self._weight, active, behind)
        dr.eval(self.layers.tensors())
        dr.sync_thread()

    def _surface(
        self, rays: CameraRays, pixel: mi.UInt32, is_hidden: mi.Bool
    ) -> tuple[Surface, mi.Bool, mi.Float | None]:
        """The first surface along a ray; where ``is_hidden``, the surface hidden by it, and the
        ray's origin is moved behind the first surface. Also returns the lanes that have a surface,
        and the blur of the front surface (infinite where not ``is_hidden``)."""
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

    def _lanes_with_margin(self, pixel: mi.UInt32, index: mi.UInt32) -> camera.Lanes:
        """Lanes for pixels of the film and its margin. Their ``pixel`` is the nearest pixel of the
        film, because the nested integrator may have tables with an entry for each pixel of the
        film."""
        corner = self.size.position(pixel) - self.margin
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
        """Replaces the block's colours and alpha with the blurred layers."""
        sums, alphas = self.layers.sums()
        if self.integrator.denoise:
            sums = [denoised(layer, self.size) for layer in sums]
        values = np.array(self.block.tensor())
        has_alpha = mi.has_flag(self.film.flags(), mi.FilmFlags.Alpha)
        # The film divides by these weights
        weight = values[..., 4 if has_alpha else 3]
        values[..., :3] = self._picture(sums) * weight[..., None]
        if has_alpha:
            for layer, alpha in zip(sums, alphas):
                layer.color = mi.Color3f(alpha)
            values[..., 3] = self._picture(sums)[..., 0] * weight
        offset = self.block.offset()
        self.block = mi.ImageBlock(mi.TensorXf(values), offset=offset)

    def _picture(self, sums: list[LayerSums]) -> np.ndarray:
        capture = Capture(self.size, sums, from_numpy(mi.Float, self.blurs))
        picture = self.filter.picture(capture)
        shape = (self.size.height, self.size.width, 3)
        return mi.TensorXf(dr.ravel(picture), shape=shape).numpy()[self._inside]
