"""Specular chains: a ray that smooth surfaces reflect and refract, with its derivatives.

Source: H. Igehy, *Tracing Ray Differentials*, SIGGRAPH 1999, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ....transport.bsdfs import sample_bsdf
from ....transport.path_decisions import SceneQuery
from .casters import Casters


@dataclass
class RayState:
    """A ray at the end of a chain, and its derivatives with respect to two coordinates of the first
    direction.

    Attributes:
        p, d: The last vertex, and the direction in which the ray leaves it.
        o: Where a ray that leaves the vertex starts, clear of the surface.
        p_s, p_t, d_s, d_t: Derivatives of ``p`` and ``d``.
        weight: Product of the values of the BSDFs.
        chance: Product of the probabilities with which the BSDFs sample these directions.
        length: The number of surfaces.
        is_sound: Whether there is such a chain.
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
        active: mi.Bool,
    ) -> RayState:
        """The chain of ``length`` surfaces that begins with the ray ``start``. Bit i of
        ``transmits`` tells whether its surface i transmits or reflects. Where ``is_open``, the
        chain ends before the first surface that is no caster, and ``length`` is its longest
        length."""
        frame = mi.Frame3f(start.d)
        ray = mi.Ray3f(start)
        state = RayState(
            mi.Point3f(start.o), mi.Vector3f(start.d), mi.Point3f(start.o), mi.Vector3f(0),
            mi.Vector3f(0), mi.Vector3f(frame.s), mi.Vector3f(frame.t), mi.Spectrum(1),
            mi.Float(1), mi.UInt32(0), mi.Bool(active),
        )
        going = mi.Bool(active) & (length > 0)
        while dr.hint(going, label="chain"):
            pi = self._query.closest(self._scene, ray, coherent=False, active=going)
            hit = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV)
            met = going & hit.is_valid() & self._casters.contain(hit.shape)
            transmit = ((transmits >> state.length) & 1) == 1
            lobe = dr.select(transmit, mi.Float(1), 0)
            bs, weight = sample_bsdf(
                hit.bsdf(ray), self._ctx, hit, lobe, mi.Point2f(0.5), met
            )
            kind = dr.select(
                transmit, mi.UInt32(int(mi.BSDFFlags.DeltaTransmission)),
                mi.UInt32(int(mi.BSDFFlags.DeltaReflection)),
            )
            sound = met & (bs.pdf > 0) & ((bs.sampled_type & kind) != 0)
            out = hit.to_world(bs.wo)
            self._differentiate(state, ray, hit, pi, bs.eta, out, transmit, sound)
            leaving = self._query.starts.along(hit, out)
            state.p = dr.select(sound, hit.p, state.p)
            state.d = dr.select(sound, out, state.d)
            state.o = dr.select(sound, leaving.o, state.o)
            state.weight = dr.select(sound, state.weight * (weight * bs.pdf), state.weight)
            state.chance = dr.select(sound, state.chance * bs.pdf, state.chance)
            ends = is_open & ~met & (state.length > 0)
            state.is_sound &= ~going | sound | ends
            ray = leaving
            state.length += dr.select(sound, mi.UInt32(1), 0)
            going = sound & (state.length < length)
        return state

    def _differentiate(self, state, ray, hit, pi, eta, out, transmit, sound) -> None:
        """Transfers the derivatives along ``ray`` to the surface ``hit``, where the ray turns to
        ``out``."""
        n = hit.sh_frame.n
        side = dr.sign(-dr.dot(n, ray.d))
        m = n * side
        c = -dr.dot(ray.d, m)
        e = dr.select(transmit, dr.rcp(eta), 1)
        cosine = -dr.dot(out, m)  # negative where the ray is reflected
        change = NormalDerivative(hit, pi, self._casters, sound)
        for i in ("s", "t"):
            dd, dp = getattr(state, "d_" + i), getattr(state, "p_" + i)
            # Transfer
            dp = dp + hit.t * dd
            dp = dp - ray.d * (dr.dot(hit.n, dp) / dr.dot(hit.n, ray.d))
            # Reflection and refraction: out = e d + μ m
            dm = change.along(dp) * side
            dc = -(dr.dot(dd, m) + dr.dot(ray.d, dm))
            μ = e * c - cosine
            dμ = dr.select(transmit, e * dc - dr.square(e) * c * dc / cosine, 2 * dc)
            setattr(state, "p_" + i, dr.select(sound, dp, getattr(state, "p_" + i)))
            setattr(state, "d_" + i, dr.select(sound, e * dd + dμ * m + μ * dm, dd))


class NormalDerivative:
    """How the shading normal changes along the surface at an interaction.

    It does not use the interaction's derivatives on meshes, because these are wrong in Mitsuba
    3.9.1 where a mesh has texture coordinates.
    """

    def __init__(self, si: mi.SurfaceInteraction3f, pi, casters: Casters, active) -> None:
        # Two vectors in the surface, and the normal's change along them
        self._u, self._v, self._n_u, self._n_v = si.dp_du, si.dp_dv, si.dn_du, si.dn_dv
        if casters.has_meshes:
            is_mesh, (e1, e2, n0, n1, n2) = casters.triangle(si.shape, pi.prim_index, active)
            b = pi.prim_uv
            n = n0 * (1 - b.x - b.y) + n1 * b.x + n2 * b.y
            length = dr.norm(n)
            inverse = dr.select(length > 0, dr.rcp(length), 0)  # 0: flat triangles
            n = n * inverse
            inverse = inverse * dr.sign(dr.dot(n, si.sh_frame.n))
            n_u, n_v = (inverse * (x - n * dr.dot(n, x)) for x in (n1 - n0, n2 - n0))
            self._u, self._v, self._n_u, self._n_v = (
                dr.select(is_mesh, x, y)
                for x, y in ((e1, self._u), (e2, self._v), (n_u, self._n_u), (n_v, self._n_v))
            )
        uu, uv, vv = (
            dr.dot(a, b) for a, b in ((self._u, self._u), (self._u, self._v), (self._v, self._v))
        )
        det = uu * vv - uv * uv
        inverse = dr.select(det > 0, dr.rcp(det), 0)
        self._a, self._b, self._c = vv * inverse, -uv * inverse, uu * inverse

    def along(self, dp: mi.Vector3f) -> mi.Vector3f:
        """The change of the normal for a step ``dp`` along the surface."""
        x, y = dr.dot(dp, self._u), dr.dot(dp, self._v)
        return self._n_u * (self._a * x + self._b * y) + self._n_v * (self._b * x + self._c * y)


def some_wavelengths() -> mi.Spectrum:
    """Wavelengths for chains whose weight is not used: directions are the same for all."""
    return mi.Spectrum(550) if mi.is_spectral else mi.Color0f()
