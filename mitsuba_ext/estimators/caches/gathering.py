"""Traces the paths that make records."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ...transport.estimator import CameraRays
from ...transport.frozen import frozen
from ...transport.walk import Walk
from ...util.arrays import from_numpy
from .cached_light import IndirectOnly
from .hemisphere import Strata, irradiance, without_outliers
from .records import Places, Records, made_of

#: Paths that are traced at a time.
_LANES = 1 << 20


class Gatherer:
    """Makes records: traces a path through each stratum of the hemisphere over a place.

    Parameters:
        scene: The scene.
        walk: Traces the paths. Its ``max_depth`` counts from the place.
        strata: The strata of the hemisphere.
        bounds: The smallest and the largest reach of a record, in widths of a pixel.
        extrapolated: The least distance over which a record's gradient is used, in widths of a
            pixel.
        share: See :func:`~.hemisphere.without_outliers`.
        seed: Seed of all random numbers.
    """

    def __init__(
        self,
        scene: mi.Scene,
        walk: Walk,
        strata: Strata,
        bounds: tuple[float, float],
        extrapolated: float,
        share: float,
        seed: int,
    ) -> None:
        self._scene, self._walk, self._strata, self._bounds = scene, walk, strata, bounds
        self._extrapolated, self._share = extrapolated, share
        self._seed, self._launches = seed, 0

    def records(self, places: Places) -> Records:
        """The records of these places."""
        made = Records.none(len(mi.Spectrum()))
        step = max(1, _LANES // self._strata.count)
        for first in range(0, len(places), step):
            made = made.joined(self._some(places[first : first + step]))
        return made

    def _some(self, places: Places) -> Records:
        frames = frames_of(places.n)
        radiance, distance = self._traced(places, frames)
        least = np.maximum(self._extrapolated * places.footprint, 1e-20)
        radiance = without_outliers(radiance, self._share)
        found = irradiance(self._strata, radiance, distance, least)
        return made_of(places, found, frames, self._bounds)

    def _traced(self, places: Places, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The radiance through each stratum, and the distance of the surface that it comes from."""
        M, N, count = self._strata.rings, self._strata.sectors, len(places)
        lanes = count * M * N
        sampler = mi.load_dict({"type": "independent"})
        seed = mi.sample_tea_32(mi.UInt32(self._seed), mi.UInt32(self._launches + 0x10000))[0]
        sampler.seed(dr.opaque(mi.UInt32, seed[0]), lanes)
        self._launches += 1
        numbers = (dr.opaque(mi.UInt32, number) for number in (M, N))
        vectors = (places.p, places.geometric, frames[:, 0], frames[:, 1], frames[:, 2])
        columns = [from_numpy(mi.Float, vector) for vector in vectors]
        program, lane = IndirectOnly(lanes), dr.arange(mi.UInt32, lanes)
        dr.eval(lane)
        walk = replace(self._walk, program=program)
        L = _traced(walk, self._scene, sampler, lane, *numbers, columns)
        dr.eval(L, program.distance)
        radiance = np.array(L).reshape(-1, count, N, M).transpose(1, 2, 3, 0)
        return radiance, np.array(program.distance).reshape(count, N, M)


@frozen(any_width=True)
def _traced(
    walk: Walk,
    scene: mi.Scene,
    sampler: mi.Sampler,
    lane: mi.UInt32,
    rings: mi.UInt32,
    sectors: mi.UInt32,
    columns: list[mi.Float],
) -> mi.Spectrum:
    """The radiance through each stratum of each place. The columns are places, geometric normals
    and the three vectors of frames."""
    place = lane // (rings * sectors)
    stratum = lane - place * (rings * sectors)
    sector = stratum // rings
    ring = stratum - sector * rings
    # Eqs. 10.6 and 10.7
    ξ = sampler.next_2d()
    squared_sine = (mi.Float(ring) + ξ.x) / mi.Float(rings)
    sine, φ = dr.sqrt(squared_sine), dr.two_pi * (mi.Float(sector) + ξ.y) / mi.Float(sectors)
    local = sine * dr.cos(φ), sine * dr.sin(φ), dr.safe_sqrt(1 - squared_sine)
    p, geometric, *frame = (dr.gather(mi.Vector3f, column, place) for column in columns)
    d = frame[0] * local[0] + frame[1] * local[1] + frame[2] * local[2]
    # As rays leave surfaces in `path`, also where the shading normal is tilted
    offset = walk.query.starts.distance(mi.Point3f(p))
    o = p + dr.mulsign(offset, dr.dot(geometric, d)) * geometric
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(o), d))
    sample = walk(scene, sampler, CameraRays(ray), mi.Bool(True))
    # Paths whose numbers are not finite count as black, as on a film
    return dr.select(dr.all(dr.isfinite(sample.L)), sample.L, 0)


def frames_of(n: np.ndarray) -> np.ndarray:
    """Two tangents and the normal: [place, 3 vectors, 3].

    Source: T. Duff et al., *Building an Orthonormal Basis, Revisited*, JCGT 6(1), 2017.
    """
    sign = np.copysign(1.0, n[:, 2])
    a = -1 / (sign + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    s = np.stack([1 + sign * n[:, 0] ** 2 * a, sign * b, -sign * n[:, 0]], axis=1)
    t = np.stack([b, sign + n[:, 1] ** 2 * a, -n[:, 1]], axis=1)
    return np.stack([s, t, n], axis=1)
