"""Irradiance and its gradients, from the radiance of a stratified hemisphere.

The hemisphere is divided into M rings and N sectors, so that each of the M · N strata has the same
share of the cosine-weighted solid angle. One ray is traced through each of them. NumPy on the host
computes the rest: arrays are [record, sector, ring, …].

Source: G. J. Ward, P. S. Heckbert, *Irradiance Gradients*, Eurographics Workshop on Rendering,
1992; H. W. Jensen et al., *State of the Art in Monte Carlo Global Illumination*, SIGGRAPH course,
2004, Eqs. 10.6 and 10.7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

#: How often outliers are cut off. Each time, the sum becomes smaller, and thus the allowed share.
_CUTS = 8


@dataclass(frozen=True)
class Strata:
    """The strata of a hemisphere.

    Attributes:
        rings: M, the number of intervals of elevation.
        sectors: N, the number of intervals of azimuth.
    """

    rings: int
    sectors: int

    @classmethod
    def about(cls, samples: int) -> Strata:
        """About ``samples`` strata, about as wide as they are high (N = π M)."""
        rings = max(1, round(math.sqrt(samples / math.pi)))
        return cls(rings, max(3, round(samples / rings)))

    @property
    def count(self) -> int:
        return self.rings * self.sectors


@dataclass
class Irradiance:
    """Irradiance at places, and how it changes from there.

    Attributes:
        value: E: [record, channel].
        rotation: The change with the normal n' is (n × n') · ``rotation``: [record, channel, 3], in
            the frame of the place.
        translation: The change with the place, in the same frame: the gradient.
        distance: The harmonic mean of the distances of what is seen: [record].
        deviation: Standard error of the brightest channel, as if there were no strata: [record].
        slope_deviation: The same of the length of ``translation``.
    """

    value: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    distance: np.ndarray
    deviation: np.ndarray
    slope_deviation: np.ndarray


def without_outliers(radiance: np.ndarray, share: float) -> np.ndarray:
    """The radiance, cut off so that no stratum holds more than ``share`` of a record's irradiance.
    Gather rays find some lights rarely, and then find much of their light at once: the record of
    such a ray would be a bright spot.

    Parameters:
        radiance: [record, sector, ring, channel].
    """
    if share >= 1:
        return radiance
    brightest = radiance.max(axis=3)
    cut = brightest
    for _ in range(_CUTS):
        cut = np.minimum(brightest, share * cut.sum(axis=(1, 2), keepdims=True))
    return radiance * (cut / np.maximum(brightest, 1e-30))[..., None]


def irradiance(
    strata: Strata, radiance: np.ndarray, distance: np.ndarray, least: np.ndarray
) -> Irradiance:
    """Estimates irradiance and its gradients.

    Parameters:
        radiance: What is seen through each stratum: [record, sector, ring, channel].
        distance: How far away that is: [record, sector, ring]; infinite where nothing was hit.
        least: For each record, the least distance that the gradient assumes for what is seen.
            Noise is divided by this distance, and no record is extrapolated over less.
    """
    M, N = strata.rings, strata.sectors
    # Of the type of the radiance: single precision takes half the time
    inverse = 1 / np.maximum(distance, 1e-30).astype(radiance.dtype)
    least = least.astype(radiance.dtype)
    value = math.pi / (M * N) * radiance.sum(axis=(1, 2))
    mean = inverse.mean(axis=(1, 2))
    translation, factor = _translation(
        strata, radiance, np.minimum(inverse, 1 / least[:, None, None])
    )
    spread = radiance.std(axis=(1, 2)).max(axis=1)
    return Irradiance(
        value,
        _rotation(strata, radiance),
        translation,
        1 / np.maximum(mean, 1e-30),
        math.pi / math.sqrt(M * N) * spread,
        factor * spread,
    )


def _rotation(strata: Strata, radiance: np.ndarray) -> np.ndarray:
    """π / MN · Σ v_k Σ tan θ_j L_jk (Ward and Heckbert; their cross product has the other order).

    tan θ and v_k are means over strata: at single samples, tan θ has infinite variance, and the
    gradient in an isotropic field would not be exactly zero.
    """
    M, N = strata.rings, strata.sectors
    θ = np.arcsin(np.sqrt(np.arange(M + 1) / M))
    tangent = M * np.diff(θ - np.sin(θ) * np.cos(θ))  # ∫ tan θ d(sin² θ)
    φ = 2 * math.pi * (np.arange(N) + 0.5) / N
    v = np.stack([-np.sin(φ), np.cos(φ), np.zeros(N)], axis=1) * _mean_over_sector(N)
    return math.pi / (M * N) * np.einsum("rkjc,j,kx->rcx", radiance, tangent, v, optimize=True)


def _translation(
    strata: Strata, radiance: np.ndarray, inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The edges between strata move with the nearer one of the two surfaces that they separate
    (Ward and Heckbert). Returns the gradient, and for each record the root of the sum of the
    squares of all factors of radiance in it: noise grows by it."""
    M, N = strata.rings, strata.sectors
    kind = radiance.dtype
    u2 = (np.arange(M + 1) / M).astype(kind)  # sin² θ at the edges of rings
    sine = np.sqrt(u2)

    # ----- Edges between rings: 2π/N Σ u_k sin θ cos² θ / min(r) (L_j − L_j−1) -----
    nearer = np.maximum(inverse[:, :, 1:], inverse[:, :, :-1])
    edge = 2 * math.pi / N * _mean_over_sector(N) * (sine * (1 - u2))[1:M]
    moves = edge.astype(kind) * nearer
    φ = 2 * math.pi * (np.arange(N) + 0.5) / N
    u = np.stack([np.cos(φ), np.sin(φ), np.zeros(N)], axis=1).astype(kind)
    step = radiance[:, :, 1:] - radiance[:, :, :-1]
    gradient = np.einsum("rkjc,rkj,kx->rcx", step, moves, u, optimize=True)
    outer = np.pad(moves, ((0, 0), (0, 0), (1, 1)))
    along_u = outer[:, :, :-1] - outer[:, :, 1:]

    # ----- Edges between sectors: Σ v_k Σ (sin θ_j+ − sin θ_j−) / min(r) (L_k − L_k−1) -----
    nearer = np.maximum(inverse, np.roll(inverse, 1, axis=1))
    moves = np.diff(sine) * nearer
    φ = 2 * math.pi * np.arange(N) / N
    v = np.stack([-np.sin(φ), np.cos(φ), np.zeros(N)], axis=1).astype(kind)
    step = radiance - np.roll(radiance, 1, axis=1)
    gradient += np.einsum("rkjc,rkj,kx->rcx", step, moves, v, optimize=True)

    # ----- The factors of each L_jk, in the tangent plane -----
    later = np.roll(moves, -1, axis=1), np.roll(v, -1, axis=0)
    squares = 0.0
    for axis in range(2):
        factor = along_u * u[:, axis, None] + moves * v[:, axis, None]
        factor -= later[0] * later[1][:, axis, None]
        squares += np.square(factor).sum(axis=(1, 2))
    return gradient, np.sqrt(squares)


def _mean_over_sector(N: int) -> float:
    """The length of the mean of the unit vectors of a sector."""
    return math.sin(math.pi / N) / (math.pi / N)
