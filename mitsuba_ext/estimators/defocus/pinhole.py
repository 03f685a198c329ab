"""The first surface along a ray from the middle of a lens, and the surface that it hides."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from ...rendering.guides import guides_of
from ...transport.lens_view import LensView, Passes
from ...transport.numbers import Numbers
from ...util.arrays import channel_mean
from .thin_lens import ThinLens

#: Surfaces whose null transmission is larger than this are skipped.
_MOST_TRANSMITTED = 0.5

#: The search for hidden surfaces begins at the depth at which the blur is this fraction of the blur
#: of the surface in front, or ...
_BEHIND = 0.5

#: ... at which it is smaller by this number of pixels: the lens sees nothing of surfaces whose blur
#: differs less.
_LEAST_STEP = 2.0


class LensCentre:
    """Camera rays from the middle of the aperture (``CameraSamples.aperture``)."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[mi.Point2f, float]:
        return mi.Point2f(0.5), 1.0


@dataclass
class Surface:
    """A surface that a ray hits.

    Attributes:
        blur: Its signed radius of the circle of confusion in pixels; that of the sky if the ray
            hits nothing.
        is_hit: Does the ray hit a surface?
        shape: The shape that was hit.
        side: The side of the surface on which the ray arrives: 1 or -1.
        guides: The auxiliary features of a denoiser: RGB of the albedo, the shading normal, and
            whether the surface is a light. Empty if there is no denoiser.
    """

    blur: mi.Float
    is_hit: mi.Bool
    shape: mi.ShapePtr
    side: mi.Float
    guides: list[mi.Float] = field(default_factory=list)


class PinholeView:
    """The scene, seen from the middle of a lens.

    Parameters:
        view: Gives the lens' rays and depths.
        scene: The scene.
        lens: Gives the blur at a depth.
        has_guides: Are the features of a denoiser computed (:attr:`Surface.guides`)?
    """

    def __init__(
        self, view: LensView, scene: mi.Scene, lens: ThinLens, has_guides: bool = False
    ) -> None:
        self._view, self._lens, self._has_guides = view, lens, has_guides
        null = int(mi.BSDFFlags.Null)
        self._has_holes = any(s.bsdf() and int(s.bsdf().flags()) & null for s in scene.shapes())

    def first(self, ray: mi.Ray3f) -> Surface:
        """The first surface along a ray."""
        return self._meet(ray, self._lets_through if self._has_holes else None, mi.Bool(True))

    def beyond(
        self, ray: mi.Ray3f, first: Surface, active: mi.Bool
    ) -> tuple[mi.Ray3f, Surface, mi.Bool]:
        """The surface that the ``first`` surface hides, where ``active``.

        The start of the ray is moved behind surfaces of the same object: to the depth at which the
        blur is half as large. Behind the focus, it is halfway to the blur of the sky.

        Returns:
            The rest of the ray, the surface that it hits, and whether there can be one: there is
            nothing behind the sky.
        """
        sky, blur = self._lens.blur_of_sky, first.blur
        start = dr.select(blur > 0, _BEHIND * blur, blur - _BEHIND * (blur - sky))
        start = dr.minimum(start, blur - _LEAST_STEP)
        active = active & first.is_hit & (start > sky)
        # The depth that has the blur ``start``
        scale = dr.opaque(mi.Float, self._lens.pixels_per_disparity)
        depth = scale / dr.select(active, start - sky, 1)
        distance = (depth - self._view.depth(ray.o)) / dr.dot(ray.d, self._view.axis)
        active &= distance < ray.maxt
        rest = mi.Ray3f(ray)
        rest.o = ray(dr.select(active, distance, 0))

        def passes(si: mi.SurfaceInteraction3f, side: mi.Float, active: mi.Bool) -> mi.Bool:
            """The rest of the ray may leave the object in front."""
            out = (si.shape == first.shape) & (side != first.side)
            return out | self._lets_through(si, side, active) if self._has_holes else out

        return rest, self._meet(rest, passes, active), active

    def _meet(self, ray: mi.Ray3f, passes: Passes | None, active: mi.Bool) -> Surface:
        guides, side = [], mi.Float(1)
        if passes or self._has_guides:
            if passes:
                si, side = self._view.surface_behind(ray, passes, active)
            else:
                si = self._view.surface(ray, active)
            p, hit, shape = si.p, si.is_valid(), si.shape
            if self._has_guides:
                shines = hit & si.shape.is_emitter()
                guides = [*guides_of(si, hit), dr.select(shines, mi.Float(1), 0)]
        else:
            pi = self._view.closest(ray, active)
            hit, shape = pi.is_valid(), pi.shape
            p = ray(dr.select(hit, pi.t, 0))
        blur = self._lens.blur_at(self._view.inverse_depth(p, hit))
        return Surface(blur, hit, shape, side, guides)

    @staticmethod
    def _lets_through(
        si: mi.SurfaceInteraction3f, side: mi.Float, active: mi.Bool
    ) -> mi.Bool:
        """Is the surface skipped because of its null transmission?"""
        through = si.bsdf().eval_null_transmission(si, active & si.is_valid())
        return channel_mean(mi.unpolarized_spectrum(through)) > _MOST_TRANSMITTED
