"""What a ray from the middle of a lens meets first, and what is behind that."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from ..defocus.thin_lens import ThinLens
from ..transport.numbers import Numbers
from ..transport.path_decisions import SceneQuery
from .guides import guides_of

#: Surfaces that a ray may pass before it counts as having met one: those that let light through,
#: and the back of what hides the rest.
_MOST_PASSED = 16

#: A surface that lets more of the light through than this is not there.
_MOST_TRANSMITTED = 0.5

#: What is hidden begins where the blur is this share of that of what hides it, or ...
_BEHIND = 0.5

#: ... less than that by so many pixels: a smaller difference shows nothing of it.
_LEAST_STEP = 2.0


class LensCentre:
    """Camera rays from the middle of the aperture (``CameraSamples.aperture``)."""

    def draw(
        self, sampler: Numbers, pixel: mi.UInt32, index: mi.UInt32
    ) -> tuple[mi.Point2f, float]:
        return mi.Point2f(0.5), 1.0


@dataclass
class Surface:
    """What a ray meets.

    Attributes:
        blur: Its signed radius of the circle of confusion in pixels; that of the sky if the ray
            meets nothing.
        is_hit: Does the ray meet a surface?
        shape: Which one.
        side: On which side of the surface the ray arrives: 1 or -1.
        guides: What guides a denoiser: RGB of the albedo, and the shading normal. Empty if nobody
            asked for them.
    """

    blur: mi.Float
    is_hit: mi.Bool
    shape: mi.ShapePtr
    side: mi.Float
    guides: list[mi.Float] = field(default_factory=list)


class PinholeView:
    """The scene from the middle of a lens.

    Parameters:
        scene, sensor, query: The query says how a ray meets the scene.
        lens: The lens, of which the sensor's camera rays begin in the middle.
        has_guides: Does a denoiser want to know the surfaces' albedo and normal?
    """

    def __init__(
        self, scene: mi.Scene, sensor: mi.Sensor, query: SceneQuery, lens: ThinLens,
        has_guides: bool = False,
    ) -> None:  # fmt: skip
        self.lens, self._scene, self._query, self._has_guides = lens, scene, query, has_guides
        to_world = mi.Transform4f(sensor.world_transform())
        self._axis = dr.normalize(to_world @ mi.Vector3f(0, 0, 1))
        self._origin = to_world @ mi.Point3f(0)
        dr.make_opaque(self._axis, self._origin)
        null = int(mi.BSDFFlags.Null)
        self._has_holes = any(s.bsdf() and int(s.bsdf().flags()) & null for s in scene.shapes())

    def first(self, ray: mi.Ray3f) -> Surface:
        """The first surface along a ray."""
        nothing = Surface(mi.Float(0), mi.Bool(False), dr.zeros(mi.ShapePtr), mi.Float(0))
        return self._meet(ray, nothing, mi.Bool(True), self._has_holes)

    def beyond(self, ray: mi.Ray3f, first: Surface) -> tuple[mi.Ray3f, Surface, mi.Bool]:
        """What the ``first`` surface hides.

        The ray is moved on, behind what belongs to the same object: where the blur is half as
        large. Behind the focus, that is half of the way to the blur of the sky.

        Returns:
            The rest of the ray, what it meets, and whether there can be anything: not behind the
            sky.
        """
        sky, blur = self.lens.blur_of_sky, first.blur
        start = dr.select(blur > 0, _BEHIND * blur, blur - _BEHIND * (blur - sky))
        start = dr.minimum(start, blur - _LEAST_STEP)
        active = first.is_hit & (start > sky)
        # The depth of which the blur is that of the start
        scale = dr.opaque(mi.Float, self.lens.pixels_per_disparity)
        depth = scale / dr.select(active, start - sky, 1)
        distance = (depth - self._depth(ray.o)) / dr.dot(ray.d, self._axis)
        active &= distance < ray.maxt
        rest = mi.Ray3f(ray)
        rest.o = ray(dr.select(active, distance, 0))
        return rest, self._meet(rest, first, active, True), active

    def _meet(self, ray: mi.Ray3f, hider: Surface, active: mi.Bool, can_pass: bool) -> Surface:
        guides = []
        if can_pass or self._has_guides:
            if can_pass:
                si, side = _walk(self, mi.Ray3f(ray), hider.shape, hider.side, active)
            else:
                si, side = self._closest(ray, active), mi.Float(1)
            p, hit, shape = si.p, si.is_valid(), si.shape
            if self._has_guides:
                guides = guides_of(si, hit)
        else:
            pi = self._query.closest(self._scene, ray, coherent=True, active=active)
            hit, shape, side = pi.is_valid(), pi.shape, mi.Float(1)
            p = ray(dr.select(hit, pi.t, 0))
        depth = dr.select(hit, self._depth(p), dr.inf)
        # Rounding at the lens itself
        blur = self.lens.blur(dr.maximum(depth, 1e-6))
        return Surface(blur, hit, shape, side, guides)

    def _depth(self, p: mi.Point3f) -> mi.Float:
        return dr.dot(p - self._origin, self._axis)

    def _closest(self, ray: mi.Ray3f, active: mi.Bool) -> mi.SurfaceInteraction3f:
        pi = self._query.closest(self._scene, ray, coherent=True, active=active)
        return self._query.interaction(pi, ray)

    def _passes(
        self, si: mi.SurfaceInteraction3f, side: mi.Float, hider: mi.ShapePtr,
        hider_side: mi.Float, active: mi.Bool,
    ) -> mi.Bool:  # fmt: skip
        """Does a ray go on: through a surface that lets light through, or out of the object that
        hides the rest?"""
        passes = (si.shape == hider) & (side != hider_side)
        if self._has_holes:
            through = si.bsdf().eval_null_transmission(si, active & si.is_valid())
            passes |= dr.mean(mi.unpolarized_spectrum(through)) > _MOST_TRANSMITTED
        return passes


@dr.syntax
def _walk(view, ray, hider, hider_side, active):
    si, side = dr.zeros(mi.SurfaceInteraction3f), mi.Float(0)
    steps, going = mi.UInt32(0), mi.Bool(active)
    while going:
        si = view._closest(ray, going)
        side = dr.sign(dr.dot(si.n, ray.d))
        passes = view._passes(si, side, hider, hider_side, going)
        going &= si.is_valid() & passes & (steps < _MOST_PASSED)
        steps += 1
        ray = dr.select(going, si.spawn_ray(ray.d), ray)
    return si, side
