"""Specular chains: a ray that casters reflect and refract, with its derivatives.

Source: H. Igehy, *Tracing Ray Differentials*, SIGGRAPH 1999, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import eval_bsdf, sample_bsdf
from ....transport.path_channels import PathChannels
from ....transport.path_decisions import SceneQuery
from .casters import Casters
from .microfacets import Microfacet, offset_at


@dataclass
class RayState:
    """A ray at the end of a chain, and its derivatives with respect to two coordinates of the first
    direction.

    Attributes:
        p, d: The last vertex, and the direction in which the ray leaves it.
        o: Where a ray that leaves the vertex starts, clear of the surface.
        p_s, p_t, d_s, d_t: Derivatives of ``p`` and ``d``.
        weight: Product of the values of the BSDFs (1 if they were not asked), and of solid angles
            per offset of rough casters, divided by the densities of offsets.
        chance: The same product with the probabilities and densities with which the BSDFs sample
            these directions.
        by_last: 1 / density with which the last BSDF does, where it is rough; 0 where no connection
            from there finds the light; ``None`` if all casters are smooth.
        length: The number of surfaces.
        is_sound: Whether there is such a chain.
        first: The first point on a caster.
        turns: The symbols of its surfaces for light path expressions, 16 bits each.
    """

    p: mi.Point3f
    d: mi.Vector3f
    o: mi.Point3f
    p_s: mi.Vector3f
    p_t: mi.Vector3f
    d_s: mi.Vector3f
    d_t: mi.Vector3f
    weight: mi.Spectrum
    chance: mi.Float
    length: mi.UInt32
    is_sound: mi.Bool
    first: mi.Point3f
    turns: mi.UInt32
    by_last: mi.Float | None

    def symbols(self) -> list[tuple[mi.UInt32, mi.Bool]]:
        """The symbol of each surface, and whether there is one."""
        return [((self.turns >> 16 * i) & 0xFFFF, self.length > i) for i in range(2)]


class Chains:
    """Traces chains.

    Parameters:
        query: How rays intersect the scene.
        ctx: The context for all calls of BSDFs.
    """

    def __init__(
        self, scene: mi.Scene, query: SceneQuery, casters: Casters, ctx: mi.BSDFContext
    ) -> None:
        self._scene, self._query, self._casters, self._ctx = scene, query, casters, ctx

    @dr.syntax
    def trace(
        self, start: mi.Ray3f, length: mi.UInt32, transmits: mi.UInt32, is_open: mi.Bool,
        active: mi.Bool, weighs: bool = False, channels: PathChannels | None = None,
        offsets: mi.Vector4f | None = None,
    ) -> RayState:
        """The chain of ``length`` surfaces that begins with the ray ``start``. Bit i of
        ``transmits`` tells whether its surface i transmits or reflects. Where ``is_open``, the
        chain ends before the first surface that is no caster, and ``length`` is its longest
        length. BSDFs are asked only if it ``weighs`` the chain, and symbols of light path
        expressions found only for ``channels``. ``offsets`` are needed if casters are rough."""
        frame = mi.Frame3f(start.d)
        ray = mi.Ray3f(start)
        state = RayState(
            mi.Point3f(start.o), mi.Vector3f(start.d), mi.Point3f(start.o), mi.Vector3f(0),
            mi.Vector3f(0), mi.Vector3f(frame.s), mi.Vector3f(frame.t), mi.Spectrum(1),
            mi.Float(1), mi.UInt32(0), mi.Bool(active),
            mi.Point3f(0), mi.UInt32(0), mi.Float(0) if self._casters.are_rough else None,
        )
        going = mi.Bool(active) & (length > 0)
        while dr.hint(going, label="chain"):
            pi = self._query.closest(self._scene, ray, coherent=False, active=going)
            met = going & pi.is_valid() & self._casters.contain(pi.shape)
            transmit = ((transmits >> state.length) & 1) == 1
            sound = self._bend(state, ray, pi, transmit, met, offsets)
            self._weigh(state, ray, pi, transmit, sound, weighs)
            self._read(state, pi, transmit, channels)
            ends = is_open & ~met & (state.length > 0)
            state.is_sound &= ~going | sound | ends
            ray.o = dr.select(sound, state.o, ray.o)
            ray.d = dr.select(sound, state.d, ray.d)
            state.length += dr.select(sound, mi.UInt32(1), 0)
            going = sound & (state.length < length)
        return state

    def _bend(self, state, ray, pi, transmit, met, offsets) -> mi.Bool:
        """Moves ``state`` along ``ray`` to the surface that it meets, and turns the ray there, with
        the derivatives. Returns whether the surface reflects or transmits it."""
        point, change = self._casters.meet(pi, ray, met)
        n, is_glass, facet = point.shading_normal, point.eta > 0, None
        if offsets is not None:
            facet = Microfacet(n, offset_at(offsets, state.length), point.roughness)
            n = facet.normal
        front = -dr.dot(n, ray.d)
        side = dr.sign(front)
        m, c = n * side, dr.abs(front)
        # Relative index of refraction of the side from which the ray comes
        e = dr.select(transmit, dr.select(front > 0, dr.rcp(point.eta), point.eta), 1)
        square = 1 - dr.square(e) * (1 - dr.square(c))
        # Negative where the ray is reflected
        cosine = dr.select(transmit, dr.sqrt(dr.maximum(square, 0)), -c)
        sound = met & (c > 0) & (~transmit | (is_glass & (square > 0)))
        sound &= transmit | ~point.is_one_sided | (front > 0)
        μ = e * c - cosine
        out = dr.normalize(e * ray.d + μ * m)
        if facet is not None:
            sound &= self._pass(point.shading_normal, n, transmit, ray.d, out)
            # Solid angle of ``out`` per solid angle of normals (Eq. 14 and 17 of B. Walter et al.,
            # *Microfacet Models for Refraction through Rough Surfaces*, EGSR 2007)
            measure = facet.measure * dr.square(μ) / dr.abs(cosine)
            measure = dr.select(sound & (point.roughness > 0), measure, 1)
            state.weight *= measure
            state.chance *= measure
        geometric = point.normal
        for i in ("s", "t"):
            dd, dp = getattr(state, "d_" + i), getattr(state, "p_" + i)
            # Transfer
            dp = dp + pi.t * dd
            dp = dp - ray.d * (dr.dot(geometric, dp) / dr.dot(geometric, ray.d))
            # Reflection and refraction: out = e d + μ m
            dn = change.along(dp)
            dm = (dn if facet is None else facet.change(dn)) * side
            dc = -(dr.dot(dd, m) + dr.dot(ray.d, dm))
            dμ = dr.select(transmit, e * dc - dr.square(e) * c * dc / cosine, 2 * dc)
            setattr(state, "p_" + i, dr.select(sound, dp, getattr(state, "p_" + i)))
            setattr(state, "d_" + i, dr.select(sound, e * dd + dμ * m + μ * dm, dd))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p, si.n = point.p, geometric
        state.first = dr.select(sound & (state.length == 0), point.p, state.first)
        state.p = dr.select(sound, point.p, state.p)
        state.d = dr.select(sound, out, state.d)
        state.o = dr.select(sound, self._query.starts.along(si, out).o, state.o)
        return sound

    def _pass(self, n: mi.Vector3f, m: mi.Vector3f, transmit, d, out) -> mi.Bool:
        """Whether a ray is on the same sides of a microfacet with the normal ``m`` and of the
        surface, whose shading normal is ``n``."""
        before, behind = dr.dot(n, d), dr.dot(n, out)
        return (before * dr.dot(m, d) > 0) & ((before * behind > 0) == transmit)

    def _weigh(self, state, ray, pi, transmit, sound, weighs: bool) -> None:
        """Multiplies weight and chance of ``state`` by the values of the surface it has met."""
        if not weighs:
            return
        hit = pi.compute_surface_interaction(ray, mi.RayFlags.All, sound)
        lobe = dr.select(transmit, mi.Float(1), 0)
        bs, weight = sample_bsdf(hit.bsdf(ray), self._ctx, hit, lobe, mi.Point2f(0.5), sound)
        kind = dr.select(
            transmit, mi.UInt32(int(mi.BSDFFlags.DeltaTransmission)),
            mi.UInt32(int(mi.BSDFFlags.DeltaReflection)),
        )  # fmt: skip
        agrees = (bs.pdf > 0) & ((bs.sampled_type & kind) != 0)
        value, pdf = weight * bs.pdf, bs.pdf
        if self._casters.are_rough:
            is_rough = self._casters.is_rough(pi.shape)
            rough = eval_bsdf(
                hit.bsdf(ray), self._ctx, hit, hit.to_local(state.d), sound & is_rough
            )
            value, pdf = (dr.select(is_rough, *pair) for pair in zip(rough, (value, pdf)))
            agrees = dr.select(is_rough, pdf > 0, agrees)
            by_last = dr.select(is_rough & (pdf > 0), dr.rcp(pdf), 0)
            state.by_last = dr.select(sound, by_last, state.by_last)
        state.weight = dr.select(sound, state.weight * value, state.weight)
        state.chance = dr.select(sound, state.chance * pdf, state.chance)
        state.is_sound &= ~sound | agrees

    def _read(self, state, pi, transmit, channels: PathChannels | None) -> None:
        """Reads the symbol of the surface that ``state`` has met."""
        if channels is not None:
            is_rough = self._casters.is_rough(pi.shape) if self._casters.are_rough else False
            symbol = channels.event(pi.shape, transmit, is_rough)
            state.turns |= dr.select(state.length < 2, symbol << (16 * state.length), 0)


def some_wavelengths() -> mi.Spectrum:
    """Wavelengths for chains whose weight is not used: directions are the same for all."""
    return mi.Spectrum(550) if mi.is_spectral else mi.Color0f()
