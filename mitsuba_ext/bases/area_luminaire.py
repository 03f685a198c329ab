"""The base class of lights on shapes whose directions are sampled by solid angle.

This file is executed once per variant (see ``registry.py``): its base class is variant-bound.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..scene.luminaires.surface import Surface
from ..scene.luminaires.surfaces import surface
from ..startup.registry import variant_bound


@variant_bound
class AreaLuminaire(mi.Emitter):
    """An emitter on a shape. Its radiance is a spectrum or texture, times the value of
    :meth:`profile` for the direction. Light leaves to the side of the shading normal, as from
    Mitsuba's ``area``.

    Attributes:
        is_projected: Whether polygons are sampled by projected solid angle.
    """

    is_projected = False

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.name = props.plugin_name()
        if "to_world" in props:
            raise ValueError(f'"{self.name}": has no to_world; the light is where its shape is')
        self.radiance = props.get_emissive_texture("radiance", 1.0)
        flags = int(mi.EmitterFlags.Surface)
        if self.radiance.is_spatially_varying():
            flags |= int(mi.EmitterFlags.SpatiallyVarying)
        self.m_flags = flags

    # ---- For derived classes ----

    def profile(self, si: mi.SurfaceInteraction3f) -> mi.Float:
        """The factor of the radiance in the direction ``si.wi``."""
        return mi.Float(1)

    def sample_profile(self, sample: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        """A direction for light that leaves (z along the normal), and its density per solid
        angle."""
        wo = mi.warp.square_to_cosine_hemisphere(sample)
        return wo, mi.warp.square_to_cosine_hemisphere_pdf(wo)

    # ---- Mitsuba's interface ----

    def _surface(self) -> Surface:
        # Not stored, since the shape may be moved. Reading its parameters costs nothing in kernels
        return surface(self.name, self.get_shape(), self.is_projected)

    def eval(self, si, active=True):
        cosine = mi.Frame3f.cos_theta(si.wi)
        radiance = self.radiance.eval(si, active) * self.profile(si)
        return dr.select(mi.Bool(active) & (cosine > 0), radiance, 0)

    def sample_direction(self, it, sample, active=True):
        active = mi.Bool(active)
        point = self._surface().sample(it, sample, active)
        si = point.si
        si.time, si.wavelengths = it.time, it.wavelengths
        ds = dr.zeros(mi.DirectionSample3f, dr.width(si.p))
        ds.p, ds.n, ds.uv, ds.time = si.p, si.sh_frame.n, si.uv, it.time
        to_light = si.p - it.p
        ds.dist = dr.norm(to_light)
        ds.d = to_light / dr.maximum(ds.dist, 1e-37)
        ds.emitter = mi.EmitterPtr(self)
        si.wi = si.to_local(-ds.d)
        is_seen = active & (dr.dot(ds.d, ds.n) < 0) & (point.pdf > 0) & dr.isfinite(point.pdf)
        ds.pdf = dr.select(is_seen, point.pdf, 0)
        weight = self.eval(si, is_seen) / dr.select(is_seen, point.pdf, 1)
        return ds, dr.select(is_seen, weight, 0)

    def pdf_direction(self, it, ds, active=True):
        is_seen = mi.Bool(active) & (dr.dot(ds.d, ds.n) < 0)
        pdf = self._surface().pdf(it, ds)
        return dr.select(is_seen & dr.isfinite(pdf), pdf, 0)

    def eval_direction(self, it, ds, active=True):
        si = mi.SurfaceInteraction3f(ds, it.wavelengths)
        si.wi = si.to_local(-ds.d)
        return self.eval(si, active)

    def sample_position(self, time, sample, active=True):
        point = self._surface().sample_area(sample, mi.Bool(active))
        ps = dr.zeros(mi.PositionSample3f, dr.width(point.si.p))
        ps.p, ps.n, ps.uv = point.si.p, point.si.sh_frame.n, point.si.uv
        ps.time, ps.pdf = time, point.pdf
        return ps, dr.select(mi.Bool(active) & (ps.pdf > 0), dr.rcp(ps.pdf), 0)

    def pdf_position(self, ps, active=True):
        return dr.select(mi.Bool(active), dr.rcp(self._surface().area()), 0)

    def sample_ray(self, time, sample1, sample2, sample3, active=True):
        active = mi.Bool(active)
        point = self._surface().sample_area(sample2, active)
        si = point.si
        # ----- The direction: about the geometric normal, on the side that emits -----
        local, pdf = self.sample_profile(sample3)
        side = dr.select(dr.dot(si.n, si.sh_frame.n) < 0, -si.n, si.n)
        d = mi.Frame3f(side).to_world(local)
        si.wi = si.to_local(d)
        # ----- Wavelengths -----
        si.time = time
        wavelengths, radiance = self.sample_wavelengths(si, sample1, active)
        si.wavelengths = wavelengths
        density = point.pdf * pdf
        shines = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (density > 0)
        scale = self.profile(si) * local.z / dr.select(shines, density, 1)
        return si.spawn_ray(d), dr.select(shines, radiance * scale, 0)

    def sample_wavelengths(self, si, sample, active=True):
        shifted = mi.sample_shifted(sample) if mi.is_spectral else si.wavelengths
        return self.radiance.sample_spectrum(si, shifted, active)

    def bbox(self):
        return self.get_shape().bbox()

    def traverse(self, callback):
        super().traverse(callback)
        callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)

    def to_string(self):
        radiance = str(self.radiance).replace("\n", "\n  ")
        return f"{type(self).__name__}[\n  radiance = {radiance}\n]"
