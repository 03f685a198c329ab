"""The first surface along a ray from the centre of a lens, and the surface that it hides."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from ...rendering.guides import guides_of
from ...transport.lens_view import LensView, Passes
from ...transport.numbers import Numbers
from ...util.arrays import channel_mean
from .thin_lens import ThinLens

#: The null transmission above which surfaces are skipped.
_MAX_TRANSMITTANCE = 0.5

#: The blur, relative to the front surface's, where the search for hidden surfaces begins, or …
_BEHIND_FRACTION = 0.5

#: … where it is smaller by this number of pixels: the lens sees nothing of surfaces whose blur
#: differs less.
_MIN_STEP = 2.0


class LensCentre:
    """Camera rays from the centre of the aperture (``CameraSamples.aperture``)."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[mi.Point2f, float]:
        return mi.Point2f(0.5), 1.0


@dataclass
class Surface:
    """A surface hit by a ray.

    Attributes:
        blur: The signed radius of its circle of confusion in pixels; the sky's if the ray hits
            nothing.
        is_hit: Whether the ray hits a surface.
        shape: The shape that was hit.
        side: The side of the surface from which the ray arrives: 1 or -1.
        guides: The auxiliary features of a denoiser: RGB of the albedo, the shading normal, and
            whether the surface is a light. Empty if there is no denoiser.
    """

    blur: mi.Float
    is_hit: mi.Bool
    shape: mi.ShapePtr
    side: mi.Float
    guides: list[mi.Float] = field(default_factory=list)


class PinholeView:
    """The scene, seen from the centre of a lens.

    Parameters:
        view: The view that provides the lens's rays and depths.
        scene: The scene.
        lens: The lens, which gives the blur at a depth.
        has_guides: Whether to compute the features of a denoiser (:attr:`Surface.guides`).
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
        """The surface hidden by the ``first`` surface, in ``active`` lanes.

        The origin of the ray is moved behind surfaces of the same object, to the depth where the
        blur is half as large. Behind the focus, it is moved halfway to the blur of the sky.

        Returns:
            The rest of the ray, the surface that it hits, and whether there can be one (not beyond
            the sky).
        """
        sky, blur = self._lens.blur_of_sky, first.blur
        start = dr.select(blur > 0, _BEHIND_FRACTION * blur, blur - _BEHIND_FRACTION * (blur - sky))
        start = dr.minimum(start, blur - _MIN_STEP)
        active = active & first.is_hit & (start > sky)
        # The depth with the blur ``start``
        scale = dr.opaque(mi.Float, self._lens.pixels_per_disparity)
        depth = scale / dr.select(active, start - sky, 1)
        distance = (depth - self._view.depth(ray.o)) / dr.dot(ray.d, self._view.axis)
        active &= distance < ray.maxt
        rest = mi.Ray3f(ray)
        rest.o = ray(dr.select(active, distance, 0))

        def passes(si: mi.SurfaceInteraction3f, side: mi.Float, active: mi.Bool) -> mi.Bool:
            """Lets the rest of the ray leave the object in front."""
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
        """Whether the surface is skipped because of its null transmission."""
        through = si.bsdf().eval_null_transmission(si, active & si.is_valid())
        return channel_mean(mi.unpolarized_spectrum(through)) > _MAX_TRANSMITTANCE
