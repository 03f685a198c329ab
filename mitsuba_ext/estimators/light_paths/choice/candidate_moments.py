"""Second moments of sets of techniques, from the samples of all of them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....util.arrays import from_numpy
from ..partial_sums import CompetingDensities
from .candidates import Candidate
from .rare_contributions import BINS, bin_of

#: The number of groups of paths.
GROUPS = 16


class CandidateMoments:
    """For each pixel and each candidate, sums over the samples of a pass: of the second moment, and
    of the light image.

    Let a candidate find a path of contribution f with the densities qᵢ. With the power heuristic,
    its second moment is the integral of f² Σ cᵢ qᵢ³ / (Σ qᵢ²)², where cᵢ is 1 except for merging.
    The densities contain the number of samples: with twice the number of connections, the densities
    of connections are twice as large.

    Whichever technique finds the path, the terms of hits, next event estimation, the light image
    and merging are known. For merging at different vertices, only the sum of the squared densities
    is known: the sum of their cubes is computed as if one vertex had all of it. Several connections
    often find the same path (corridor: up to four, whose cubes would be overestimated by half), so
    only the connection that found the path adds its own term. So does merging in scenes with media,
    where a path may have many vertices that are merged.

    A camera path that scatters in a beam of light meets many photons there, and few camera paths
    do: the photons of a camera path depend on each other. For each candidate that merges, the sum
    of what photons bring to a camera path shows this (:meth:`merged`).

    In fog, a light path may bring light to many pixels, and a few paths most of a second moment.
    Sums over groups of paths show this, where contrast between pixels does not
    (:meth:`by_group`).

    Parameters:
        candidates: The candidates. The one without light paths has only the techniques of ``path``.
        pixels: Number of pixels.
        merging: c of merging, with which any technique adds the term of merging; ``None`` if
            merging adds its own term, in scenes with media.
        lanes: Number of camera paths, if merging adds its own term.
        blocks: Number of blocks of pixels, for each of which there are sums by value, and by group.
        block_of: The block of each pixel; ``None`` if each has its own.
    """

    def __init__(
        self,
        candidates: list[Candidate],
        pixels: int,
        merging: float | None,
        lanes: int,
        blocks: int,
        block_of: mi.UInt32 | None,
    ) -> None:
        self._count, self._size = len(candidates), blocks
        # Opaque: trials of all sizes share their kernel
        self._pixels, self._blocks = (dr.opaque(mi.UInt32, x) for x in (pixels, blocks))
        self._block_of, self._merging_is_own = block_of, merging is None
        # Factors of the squared densities of light image, connections, merging; and c of merging
        # (or, if merging adds its own term, the number of the candidate among those that merge)
        merges = [c.merges for c in candidates]
        fourth = np.cumsum(merges) - 1 if merging is None else [merging] * self._count
        self._factors = from_numpy(mi.Float, [
            (c.light_paths**2, (c.light_paths > 0) * c.connections**2, c.merges, x)
            for c, x in zip(candidates, fourth)
        ])  # fmt: skip
        self._lanes = self._merged = None
        if merging is None:
            self._lanes = dr.opaque(mi.UInt32, lanes)
            self._merged = dr.zeros(mi.Float, 2 * sum(merges) * lanes)
        self._sums = dr.zeros(mi.Float, 2 * self._count * pixels)
        self._by_value = dr.zeros(mi.Float, 2 * self._count * blocks * BINS)
        self._by_group = dr.zeros(mi.Float, self._count * GROUPS * blocks)
        dr.eval(self._sums, self._by_value, self._by_group, self._merged)

    @dr.syntax
    def add(
        self, brought, mis, competing, pixel, path, active, count: float = 1.0,
        is_joined: bool = False,
        merging: mi.Float | None = None, lane: mi.UInt32 | None = None,
    ) -> None:  # fmt: skip
        """Adds a contribution.

        Parameters:
            brought: The contribution, with its MIS weight ``mis``.
            competing: Densities of the techniques, including the one that found the contribution.
            pixel: The pixel of the contribution.
            path: The number of the light path that brought it; of the camera path if there is none.
            count: The number of such contributions that MIS weights count as one sample.
            is_joined: Whether a connection of a camera path to a light path found it.
            merging, lane: c of merging, and the lane of the camera path, if merging found it and
                adds its own term.
        """
        active &= brought > 0
        square = count * dr.square(brought) / mis
        block = pixel
        if self._block_of is not None:
            block = dr.gather(mi.UInt32, self._block_of, pixel, active)
        index = mi.UInt32(0)
        while index < mi.UInt32(self._count):
            factors = dr.gather(mi.Vector4f, self._factors, index)
            inverse, image, own_share, is_possible = _split(
                factors, competing, dr.rcp(mis), is_joined, self._merging_is_own, merging
            )
            moment = square * inverse
            is_found = active & dr.isfinite(moment)
            place = 2 * (index * self._pixels + pixel)
            add_to(self._sums, moment, place, is_found)
            add_to(self._sums, brought * image, place + 1, is_found)
            value_bin = dr.select(is_possible, bin_of(moment / brought), BINS - 1)
            place = 2 * ((index * self._blocks + block) * mi.UInt32(BINS) + value_bin)
            add_to(self._by_value, brought, place, is_found)
            add_to(self._by_value, moment, place + 1, is_found)
            place = (index * mi.UInt32(GROUPS) + path % GROUPS) * self._blocks + block
            add_to(self._by_group, moment, place, is_found)
            if dr.hint(merging is not None, mode="scalar"):
                part = brought / mis * own_share
                merges = is_found & (factors.z > 0)
                place = 2 * (mi.UInt32(factors.w) * self._lanes + lane)
                add_to(self._merged, part, place, merges)
                add_to(self._merged, dr.square(part), place + 1, merges)
            index += 1

    def taken(self) -> tuple[np.ndarray, np.ndarray]:
        """The sums, [candidate, pixel, 2]; and the sums of light and second moment by the value of
        contributions, [candidate, block, bin, 2]."""
        by_value = self._by_value.numpy().reshape(self._count, self._size, BINS, 2)
        return self._sums.numpy().reshape(self._count, -1, 2), by_value

    def by_group(self) -> np.ndarray:
        """The second moments that groups of paths have found, [candidate, group, block]."""
        return self._by_group.numpy().reshape(self._count, GROUPS, self._size)

    def merged(self, lanes: int) -> np.ndarray:
        """For each candidate that merges: the sum, and the sum of the squares, of what photons
        bring to each camera path, [candidate, lane, 2]; of no candidate if merging does not add its
        own term."""
        found = np.zeros(0) if self._merged is None else self._merged.numpy()
        return found.reshape(-1, lanes, 2).astype(np.float64)


def add_to(target: mi.Float, value: mi.Float, place: mi.UInt32, active: mi.Bool) -> None:
    """Adds values to elements of an array. Dr.Jit alone would give each thread a copy of a small
    array, and compile the size of the array into the kernel."""
    dr.scatter_add(target, value, place, active, dr.ReduceMode.Direct)


def _split(
    factors: mi.Vector4f, competing: CompetingDensities, total: mi.Float, is_joined: bool,
    merging_is_own: bool, own_merging: mi.Float | None,
) -> tuple[mi.Float, mi.Float, mi.Float, mi.Bool]:  # fmt: skip
    """Σ cᵢ qᵢ³ / (Σ qᵢ²)² in units of the technique that found a path; the MIS weight of the light
    image, and of merging at the vertex where it was found; and whether the candidate can find the
    path. ``total`` is Σ qᵢ² of all techniques."""
    connections, image = competing.by_kind
    hit, next_event = (dr.square(q) for q in competing.by_camera)
    merging = dr.maximum(total - (hit + next_event + connections + image), 0)
    squares = [
        hit, next_event, factors.x * image, factors.y * connections, factors.z * merging
    ]  # fmt: skip
    largest = squares[0]
    for square in squares[1:]:
        largest = dr.maximum(largest, square)
    # In units of the largest one: powers would be too small for floats
    inverse = dr.select(largest > 0, dr.rcp(largest), 0)
    shares = [square * inverse for square in squares]
    cubes = [share * dr.sqrt(share) for share in shares]
    # Connections: that which found the path, whose own MIS weight is left out of the estimate
    cubes[3] = mi.Float(0)
    if is_joined:
        own = factors.y * inverse
        cubes[3] = own * dr.sqrt(own) * total
    if not merging_is_own:
        cubes[-1] *= factors.w
    elif own_merging is None:
        cubes[-1] = mi.Float(0)
    else:
        own = factors.z * inverse
        cubes[-1] = own * dr.sqrt(own) * total * own_merging
    whole = dr.maximum(_sum(shares), 1)
    found = _sum(cubes) / dr.square(whole) * dr.sqrt(inverse)
    return found, shares[2] / whole, factors.z * inverse / whole, largest > 0


def _sum(values: list[mi.Float]) -> mi.Float:
    return sum(values[1:], values[0])
