"""Rough casters: a chain with given microfacet normals.

Rough glass scatters light as many small smooth panes do, whose normals are distributed around the
shading normal. Where each surface of a chain has a given *offset*, the slope of its
microfacet in units of the roughness, the chain is as specular as one through smooth surfaces. Its
light is then divided by the density of the offsets.

Source: T. Zeltner, I. Georgiev, W. Jakob, *Specular Manifold Sampling for Rendering High-Frequency
Caustics and Glints*, SIGGRAPH 2020, section 4.3. Ours differs in this: all distributions share one
density of offsets, so that an offset does not depend on the surface that will be met.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ....transport.numbers import hashed_2d

#: Chains with larger offsets are left to scattering and connections of rough surfaces. (A tenth of
#: the light of the GGX distribution has larger ones.)
_LARGEST = 3.0

#: The numbers of hashes from which offsets come. No trial uses them.
_OFFSETS = 0xFFFE0000

#: The part of the GGX distribution whose slopes are not larger.
_WITHIN = _LARGEST**2 / (1 + _LARGEST**2)

#: The pole of all frames, and two axes perpendicular to it. Frames jump where a normal is
#: perpendicular to the pole, so that the pole is not one that walls or floors are likely to have.
_POLE, _S, _T = (0.48, 0.64, 0.6), (0.8, -0.6, 0.0), (0.36, 0.48, -0.8)


def random_offsets(seed: mi.UInt32) -> mi.Vector4f:
    """The offsets of two surfaces, two coordinates each."""
    a, b = (_slope(hashed_2d(seed, mi.UInt32(_OFFSETS + i))) for i in range(2))
    return mi.Vector4f(a.x, a.y, b.x, b.y)


def offset_at(offsets: mi.Vector4f, index: mi.UInt32) -> mi.Vector2f:
    """The offset of surface ``index`` of a chain."""
    is_first = index == 0
    return mi.Vector2f(
        dr.select(is_first, offsets.x, offsets.z), dr.select(is_first, offsets.y, offsets.w)
    )


def with_offset(
    offsets: mi.Vector4f, index: mi.UInt32, offset: mi.Vector2f
) -> mi.Vector4f:
    """``offsets``, with this offset for surface ``index``."""
    first, second = index == 0, index == 1
    return mi.Vector4f(
        dr.select(first, offset.x, offsets.x), dr.select(first, offset.y, offsets.y),
        dr.select(second, offset.x, offsets.z), dr.select(second, offset.y, offsets.w),
    )  # fmt: skip


def offset_density(offset: mi.Vector2f) -> mi.Float:
    """The density of offsets: the slopes of the GGX distribution, up to the largest. No
    distribution of Mitsuba is more than 1.5 times as dense anywhere."""
    return dr.inv_pi / (_WITHIN * dr.square(1 + dr.squared_norm(offset)))


def is_offset(offset: mi.Vector2f) -> mi.Bool:
    """Whether this is no larger than the largest offset; false for NaN."""
    return dr.squared_norm(offset) <= _LARGEST**2


def offset_between(
    wi: mi.Vector3f, wo: mi.Vector3f, n: mi.Normal3f, eta: mi.Float, roughness: mi.Float
) -> mi.Vector2f:
    """The offset of the microfacet that scatters light between two directions.

    Args:
        wi, wo, n: Two directions away from the surface, and its shading normal.
        eta: The index of refraction of the side of ``wo`` / the index of the side of ``wi``; 1 for
            reflection.
    """
    h = wi + wo * eta
    h = dr.mulsign(dr.normalize(h), dr.dot(h, n))
    m = _turned(mi.Vector3f(n), h)
    scale = dr.rcp(roughness * dr.dot(m, mi.Vector3f(_POLE)))
    return scale * mi.Vector2f(dr.dot(m, mi.Vector3f(_S)), dr.dot(m, mi.Vector3f(_T)))


def _slope(u: mi.Point2f) -> mi.Vector2f:
    x, φ = _WITHIN * u.x, dr.two_pi * u.y
    return dr.sqrt(x / (1 - x)) * mi.Vector2f(dr.cos(φ), dr.sin(φ))


# Not a dataclass: it is no state of a loop
class Microfacet:
    """A microfacet with an offset.

    Attributes:
        normal: Its normal.
        measure: Solid angle of normals per area of offsets, divided by the density of the offset.
    """

    def __init__(self, n: mi.Vector3f, offset: mi.Vector2f, roughness: mi.Float) -> None:
        slope = roughness * offset
        up = mi.Vector3f(_POLE) + slope.x * mi.Vector3f(_S) + slope.y * mi.Vector3f(_T)
        cosine = dr.rsqrt(1 + dr.squared_norm(slope))
        self._n, self._local = n, up * cosine
        self.normal = _turned(n, self._local)
        self.measure = dr.square(roughness) * cosine**3 / offset_density(offset)

    def change(self, dn: mi.Vector3f) -> mi.Vector3f:
        """The change of its normal where the shading normal changes by ``dn``."""
        pole, m = mi.Vector3f(_POLE), self._local
        side = dr.sign(dr.dot(pole, self._n))
        w, dw = pole + side * self._n, side * dn
        k = dr.rcp(dr.dot(w, pole))
        dk = -dr.square(k) * dr.dot(dw, pole)
        wm = dr.dot(w, m)
        return side * (w * (dk * wm + k * dr.dot(dw, m)) + dw * (k * wm))


def _turned(n: mi.Vector3f, x: mi.Vector3f) -> mi.Vector3f:
    """``x`` in a frame that is turned from the pole to ``n``; twice, it is ``x`` again. (A
    reflection that maps one to the other: the distributions are symmetric.)"""
    pole = mi.Vector3f(_POLE)
    side = dr.sign(dr.dot(pole, n))
    w = pole + side * n
    return side * (w * (dr.dot(w, x) / dr.dot(w, pole)) - x)
