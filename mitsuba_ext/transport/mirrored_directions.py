"""Pairs of samples whose derivatives with respect to roughness cancel where light is uniform.

A rough surface samples microfacet normals by their density D, which depends on the roughness α. The
derivative ∂D/∂α is negative near the normal and positive far from it: a small change of α moves
light from the former to the latter, and changes nothing where both see the same light. A single
sample has ±L · 2/α nevertheless, which is much more than the derivative.

Two samples of a pair therefore see both parts. At a rough vertex, they have the numbers u and
T(u). T maps the normals of the negative part onto the positive part, so that both have the same
share of |∂D/∂α|: the derivatives of a pair are those of ∂D/∂α times the difference of light. Behind
that vertex, both have the same random numbers, so that the noise of their light is similar, too.

With t = tan θ / α, the negative part is t < 1, for GGX and for Beckmann's distribution. GGX: the
quantile of t is v = t² / (1 + t²), and ∂D/∂α is proportional to 2v − 1: T(v) = 1 − v. Beckmann:
w = t² has the density exp(−w), and ∂D/∂α is proportional to w − 1: T solves
T(w) exp(−T(w)) = w exp(−w). This map stretches areas, by |w − 1| / |T(w) − 1|. The stretch would
remain in the derivatives of later vertices, which it keeps from cancelling: there, T exchanges the
quantiles v and 1 − v of w, which leaves a third of the variance.

These maps are exact for paths that arrive along the normal. Elsewhere, only visible normals are
sampled, and cancellation is not complete, but the estimate remains unbiased. At grazing angles and
on very rough surfaces, the derivatives of a pair no longer have opposite signs: there are no pairs.

Sources: Y. Belhe, B. Xu, S. P. Bangaru, R. Ramamoorthi, T.-M. Li, *Importance Sampling BRDF
Derivatives*, ACM Transactions on Graphics 43(3), 2024, section 4 (the two parts of a derivative);
C. Zhang, Z. Dong, M. Doggett, S. Zhao, *Antithetic Sampling for Monte Carlo Differentiable
Rendering*, ACM Transactions on Graphics 40(4), 2021, section 4 (pairs of BSDF samples).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..scene.gradients import Distribution, RoughBSDFs
from .numbers import hashed_2d
from .path_decisions import DirectionSamples

#: The largest α, and the largest α tan θ for an angle of incidence θ, of a vertex with pairs. In
#: constant light, pairs of GGX have 0.3 of the variance of single samples with α tan θ = 0.19, and
#: 1.2 with 0.57 (α = 0.05).
_ROUGHEST, _MOST_GRAZING = 0.5, 0.3


@dataclass
class PairedNumbers:
    """The numbers of a sampler, for lanes that form pairs: the second of two lanes follows the
    first. From a vertex on where :meth:`share` is called, both lanes of a pair draw the same
    numbers, which do not come from the sampler.

    Attributes:
        sampler: Draws the numbers before.
        word: Chooses the sequence of a pair.
        index: How many numbers of it a lane has drawn.
        shares: Whether a lane draws from it.
        is_second: Whether a lane is the second of its pair.
    """

    sampler: mi.Sampler
    word: mi.UInt32
    index: mi.UInt32
    shares: mi.Bool
    is_second: mi.Bool

    @classmethod
    def begin(cls, sampler: mi.Sampler, seed: mi.UInt32) -> PairedNumbers:
        """Before the first number. ``sampler`` has been seeded for all lanes. ``seed`` is an opaque
        number."""
        lane = dr.arange(mi.UInt32, sampler.wavefront_size())
        word, _ = mi.sample_tea_32(seed, lane >> 1)
        numbers = cls(sampler, word, mi.UInt32(0), mi.Bool(False), (lane & 1) == 1)
        dr.eval(numbers.word, numbers.is_second)
        return numbers

    def clone(self) -> PairedNumbers:
        """A copy: drawing from it does not change this."""
        state = self.word, mi.UInt32(self.index), mi.Bool(self.shares), self.is_second
        return PairedNumbers(self.sampler.clone(), *state)

    def sample_count(self) -> int:
        """Samples per pixel."""
        return self.sampler.sample_count()

    def share(self, where: mi.Bool) -> None:
        """Lanes draw the numbers of their pair from now on."""
        self.shares = self.shares | where

    def next_1d(self, active: mi.Bool | bool = True) -> mi.Float:
        self.index = self.index + 1
        shared = hashed_2d(self.word, self.index).x
        return dr.select(self.shares, shared, self.sampler.next_1d(active))

    def next_2d(self, active: mi.Bool | bool = True) -> mi.Point2f:
        self.index = self.index + 1
        shared = hashed_2d(self.word, self.index)
        return dr.select(self.shares, shared, self.sampler.next_2d(active))


class MirroredDirections(DirectionSamples):
    """Where the first vertex of a path has a narrow lobe whose roughness is optimized, the two
    lanes of a pair get numbers that mirror each other, there and at each later vertex of this kind.
    These vertices are not guided. For :class:`PairedNumbers`.

    MIS weights remain the weights of uniform numbers, as in
    :class:`~mitsuba_ext.techniques.guided_directions.decisions.GuidedDirections`.

    Parameters:
        inner: The decision elsewhere.
        bsdfs: The BSDFs whose roughness is optimized.
    """

    def __init__(self, inner: DirectionSamples, bsdfs: RoughBSDFs) -> None:
        self._inner, self._bsdfs = inner, bsdfs
        self.gives_directions = inner.gives_directions

    def begin(self, sampler, ray, pixel):
        return self._inner.begin(sampler, ray, pixel)

    def draw(self, state, sampler: PairedNumbers, vertex, active):
        kind, α = self._bsdfs.at(vertex.bsdf)
        grazing = α * mi.Frame3f.tan_theta(vertex.si.wi)
        is_narrow = active & (kind != int(Distribution.NONE))
        is_narrow &= (α < _ROUGHEST) & (dr.abs(grazing) < _MOST_GRAZING)
        sampler.share(is_narrow & (vertex.depth == 0))
        is_narrow &= sampler.shares
        sample_1, sample_2, weight, state = self._inner.draw(
            state, sampler, vertex, active & ~is_narrow
        )
        is_second = is_narrow & sampler.is_second
        for known, mirror in _MAPS.items():
            if self._bsdfs.has(known):
                mirrored, stretch = mirror(sample_2, vertex.depth == 0)
                here = is_second & (kind == int(known))
                sample_2 = dr.select(here, mirrored, sample_2)
                weight = dr.select(here, stretch, weight)
        return sample_1, sample_2, weight, state


def mirrored_ggx(u: mi.Point2f, _is_first: mi.Bool) -> tuple[mi.Point2f, mi.Float]:
    """T for the numbers with which Mitsuba samples visible normals of GGX, and how much it
    stretches areas. They are points of a disk, by the concentric map, whose squared radius is the
    quantile of t."""
    q = dr.fma(u, 2, -1)
    radius = dr.maximum(dr.abs(q.x), dr.abs(q.y))
    # The centre of the disk belongs to all points of its edge
    scale = dr.safe_sqrt(1 - dr.square(radius)) / dr.maximum(radius, 1e-6)
    return _from_square(q * scale), mi.Float(1)


def mirrored_beckmann(u: mi.Point2f, is_first: mi.Bool) -> tuple[mi.Point2f, mi.Float]:
    """T for the numbers with which Mitsuba samples visible normals of Beckmann's distribution, and
    how much it stretches areas. They are the quantiles of the two normally distributed slopes.
    Where ``is_first`` is false, T exchanges quantiles."""
    q = dr.clip(dr.fma(u, 2, -1), -0.999999, 0.999999)
    slope = mi.Point2f(dr.erfinv(q.x), dr.erfinv(q.y))
    w = dr.maximum(dr.squared_norm(slope), 1e-10)
    other = dr.select(is_first, _other_root(w), -dr.log(1 - dr.exp(-w)))
    # Both are 1 where they meet, and so is the ratio of their distances to 1
    stretches = is_first & (dr.abs(w - 1) > 1e-2)
    stretch = dr.select(stretches, dr.abs((w - 1) / (other - 1)), 1)
    slope *= dr.sqrt(other / w)
    return _from_square(mi.Point2f(dr.erf(slope.x), dr.erf(slope.y))), stretch


def _from_square(q: mi.Point2f) -> mi.Point2f:
    """Numbers in [0, 1) for numbers in [-1, 1]."""
    return dr.clip(dr.fma(q, 0.5, 0.5), 0, dr.one_minus_epsilon(mi.Float))


def _other_root(w: mi.Float) -> mi.Float:
    """The solution x ≠ w of x exp(−x) = w exp(−w), which is on the other side of 1."""
    k = w - dr.log(w)  # x − log x has the same value
    ε = w - 1
    near = 1 - ε * (1 - ε * (2 / 3 - ε * (4 / 9)))
    small = dr.exp(-k) * (1 + dr.exp(-k))
    x = dr.select(ε > 0, small, k + dr.log(k + 0.5))
    x = dr.select(dr.abs(ε) < 0.4, near, x)
    for _ in range(3):  # Halley's method, for x − log x = k
        f, slope = x - dr.log(x) - k, 1 - dr.rcp(x)
        step = 2 * f * slope / (2 * dr.square(slope) - f * dr.rcp(dr.square(x)))
        x = dr.select(dr.abs(ε) < 0.05, x, dr.maximum(x - step, 1e-12))
    return x


_MAPS = {Distribution.GGX: mirrored_ggx, Distribution.BECKMANN: mirrored_beckmann}
