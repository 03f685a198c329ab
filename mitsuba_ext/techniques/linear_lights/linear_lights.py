"""Choosing among lights by an estimate of the contribution of each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.bounds import scene_bounds, shape_bounds
from ...scene.bsdfs import is_in_table, opaque_bsdfs
from ...scene.lights.division import emitter_shapes
from ...scene.lights.light_cells import LightCells
from ...scene.lights.weights import power_weights
from ...scene.movers import is_moving_light
from ...transport.path_decisions import EmitterSampling
from ...util.arrays import from_numpy
from ...util.spectra import comparison_wavelengths

#: Added to the largest cosine under which a vertex sees a light. Glossy reflection does not
#: decrease with the cosine, and only a light this far below the tangent plane gets the estimate 0.
_LEAST_COSINE = 0.02

#: Rounding errors, relative to the largest coordinate of the scene.
_ROUNDING = 4e-6


@dataclass
class Estimates:
    """The inputs and the sum of the estimates at a vertex.

    Attributes:
        normal: Shading normal, on the side that is seen.
        is_opaque: Whether only light from the side of the normal contributes.
        total: Sum of the estimates of all emitters.
    """

    normal: mi.Normal3f
    is_opaque: mi.Bool
    total: mi.Float


class LinearChoice(EmitterSampling):
    """Chooses emitter i with the probability α_i = e_i / Σ e_j, then a point on it; e_i estimates
    what emitter i contributes to the vertex if it is not occluded.

    All emitters are visited at each vertex: the cost is linear in their number (hence the name). In
    exchange, the probabilities fit each vertex and its normal, and no table has to be learned. With
    24 lamps a sample takes a third longer than with ``path``, with 1000 eight times as long.

    The estimate is the emitter's power, as irradiance at the distance of its bounding sphere, times
    the largest cosines under which the vertex sees this sphere and, if the light is flat, under
    which the sphere sees the vertex. It is zero only where the whole sphere lies below the tangent
    plane of an opaque surface, or the vertex behind the plane of a rectangle or disk. Where all
    estimates are zero, emitters are chosen uniformly. Neither BSDFs nor the cones of spots are
    considered. An emitter whose ``sampling_weight`` is zero is not chosen; other weights are
    factors of the estimates.

    Source: Shirley et al., *Monte Carlo Methods in Rendering*, SIGGRAPH course, section 3.4.2,
    "Linear α_i", whose geometry term of one is replaced by a bound.

    Parameters:
        scene: The scene whose emitters are chosen from.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.count = len(scene.emitters())
        self.choice_dimension = 1 if self.count > 1 else 0
        if self.count == 0:
            return
        self.cells = LightCells(scene, None)
        if self.count > 1:
            self._opaque = opaque_bsdfs(scene)
            self._block = max(4, round(self.count**0.5))
            self._block_count = -(-self.count // self._block)
            self._tabulate(scene)

    def _tabulate(self, scene: mi.Scene) -> None:
        """Makes the tables of the estimates: a row is read by three fetches."""
        bbox = scene_bounds(scene)
        has_extent = bbox.valid()
        sphere = bbox.bounding_sphere() if has_extent else mi.ScalarBoundingSphere3f(0.0, 1.0)
        extent = float(np.abs([bbox.min, bbox.max]).max()) if has_extent else 1.0
        self._margin = mi.Float(_ROUNDING * extent)
        dr.make_opaque(self._margin)
        power = power_weights(scene, self.cells).numpy().astype(np.float64)
        ds = _samples(scene, mi.Point3f(sphere.center))
        rows = [
            _row(emitter, shape, *(v[:, i] for v in ds), float(sphere.radius), extent)
            for i, (emitter, shape) in enumerate(zip(scene.emitters(), emitter_shapes(scene)))
        ]
        place, plane, size = (np.array(column) for column in zip(*rows))
        size[:, 1] *= power
        # In units of the largest, so that neither a sum nor a quotient leaves the range of a float
        size[:, 1] /= max(size[:, 1].max(), 1e-300)
        self._place, self._plane, self._size = (
            from_numpy(mi.Float, table) for table in (place, plane, size)
        )
        positive = power > 0 if np.any(power > 0) else np.ones(self.count, bool)
        candidates = np.flatnonzero(positive)
        self._candidate_count = len(candidates)
        self._candidates = from_numpy(mi.UInt32, candidates)
        self._uniform = from_numpy(mi.Float, positive / len(candidates))

    def begin(self, sampler, ray, pixel=None) -> Any:
        return Estimates(mi.Normal3f(0), mi.Bool(False), mi.Float(0)) if self.count > 1 else None

    def visit(self, state, scene, si, active):
        if self.count == 1:
            return None
        normal = dr.mulsign(si.sh_frame.n, si.wi.z)
        is_opaque = active & is_in_table(self._opaque, si.bsdf())
        total, sums = self._sums(si.p, normal, is_opaque, active)
        return Estimates(normal, is_opaque, total), sums

    def sample(self, place, scene, numbers, si, active):
        if self.count == 1:
            return *self.cells.sample(mi.UInt32(0), si, numbers.point, active), None
        made_from, sums = place
        index, probability = self._choose(
            si.p, made_from.normal, made_from.is_opaque, made_from.total, sums, numbers.choice,
            active,
        )  # fmt: skip
        ds, weight = self.cells.sample(index, si, numbers.point, active)
        ds.pdf *= probability
        return ds, dr.select(probability > 0, weight / probability, 0), None

    def remember(self, place, scene, d, pdf, active):
        return place[0] if self.count > 1 else None

    def density(self, state, scene, ref, si, ds, active):
        # Whole emitters: the number of a cell is the number of its emitter
        index, pdf = self.cells.pdf(ref, si, ds, active)
        if self.count > 1:
            e = self._estimate(index, ref.p, state.normal, state.is_opaque, active)
            pdf *= self._probability(index, e, state.total, active)
        # Also where the lookups above were masked, the density must be a number
        return dr.select(active, pdf, 0)

    def probability(self, state, scene, ref, emitter, active):
        if self.count == 1:
            return mi.Float(1)
        e = self._estimate(emitter, ref.p, state.normal, state.is_opaque, active)
        return self._probability(emitter, e, state.total, active)

    # The first pass sums the estimates, also up to the end of each block of about √n emitters. The
    # second pass searches the blocks, and then one block. Reservoir sampling needs no second pass,
    # but rescales the random number at each emitter: its 24 bits would be used up, and stratified
    # numbers would lose their strata.

    @dr.syntax
    def _sums(self, p, normal, is_opaque, active) -> tuple[mi.Float, dr.Local[mi.Float]]:
        """Σ e_j, and the running sums at the end of each block."""
        sums = dr.alloc_local(mi.Float, self._block_count)
        total, index = mi.Float(0), mi.UInt32(0)
        while dr.hint(active & (index < self.count), label="estimates"):
            total += self._estimate(index, p, normal, is_opaque, active)
            sums.write(total, index // self._block, active)
            index += 1
        return total, sums

    @dr.syntax
    def _choose(self, p, normal, is_opaque, total, sums, x, active) -> tuple[mi.UInt32, mi.Float]:
        """The first emitter at which the sum of the estimates exceeds x · Σ e_j, and α_i."""
        # A uniform choice, for vertices where all estimates are zero: the loops are skipped there
        slot = dr.minimum(mi.UInt32(x * self._candidate_count), self._candidate_count - 1)
        chosen = dr.gather(mi.UInt32, self._candidates, slot, active)
        chosen_e = mi.Float(0)
        target = x * total
        is_searched = active & (total > 0)

        block, before, running = mi.UInt32(0), mi.Float(0), mi.Float(0)
        searching = mi.Bool(is_searched)
        while dr.hint(searching, label="block"):
            before = running
            running = sums.read(block, searching)
            searching &= (running <= target) & (block + 1 < self._block_count)
            block += dr.select(searching, 1, 0)

        # The sums are from the first pass. Only by rounding can all stay below the target: then
        # the last visited emitter whose estimate is not zero is chosen
        index = block * self._block
        searching = mi.Bool(is_searched)
        while dr.hint(searching, label="choice"):
            e = self._estimate(index, p, normal, is_opaque, searching)
            before += e
            is_candidate = e > 0
            chosen = dr.select(is_candidate, index, chosen)
            chosen_e = dr.select(is_candidate, e, chosen_e)
            index += 1
            searching &= (before <= target) & (index < self.count)
        return chosen, self._probability(chosen, chosen_e, total, active)

    def _probability(self, index, e, total, active) -> mi.Float:
        # Eq. 3.8 (Shirley)
        return dr.select(
            total > 0, e / total, dr.gather(mi.Float, self._uniform, index, active)
        )

    def _estimate(self, index, p, normal, is_opaque, active) -> mi.Float:
        place = dr.gather(mi.Vector4f, self._place, index, active)
        plane = dr.gather(mi.Vector4f, self._plane, index, active)
        size = dr.gather(mi.Vector2f, self._size, index, active)
        radius, strength = size.x, size.y
        # Lights at infinity have w = 0: a direction in place of a centre
        v = mi.Vector3f(place.x, place.y, place.z) - place.w * p
        # Radii are positive
        distance_2 = dr.maximum(dr.squared_norm(v), dr.square(radius))
        inv_distance = dr.rsqrt(distance_2)
        height = dr.dot(normal, v)
        height = dr.select(is_opaque, height, dr.abs(height))
        received = dr.clip((height + radius) * inv_distance + _LEAST_COSINE, 0, 1)
        # The plane of a light that is not flat is 0, its reach infinite
        height = -dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), v)
        emitted = dr.minimum((height + plane.w) * inv_distance, 1)
        emitted = dr.select(height >= -self._margin, emitted, 0)
        return strength * received * emitted * dr.square(inv_distance)


def _samples(scene: mi.Scene, center: mi.Point3f) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, normal and direction of one direction sample of each emitter; shape [3, emitters]
    each."""
    count = len(scene.emitters())
    ref = dr.zeros(mi.Interaction3f, count)
    ref.p, ref.wavelengths = center, comparison_wavelengths(count)
    ds, _weight = scene.emitters_dr().sample_direction(ref, mi.Point2f(0.5), mi.Bool(True))
    zero = dr.zeros(mi.Float, count)
    p, n, d = (np.array(v + zero, dtype=np.float64) for v in (ds.p, ds.n, ds.d))
    return p, n, d


def _row(
    emitter: mi.Emitter,
    shape: mi.Shape | None,
    p: np.ndarray,
    n: np.ndarray,
    d: np.ndarray,
    scene_radius: float,
    extent: float,
) -> tuple[list[float], list[float], list[float]]:
    """An emitter in the tables: centre and w; normal and reach; radius, and the factor that turns
    power into strength, which is the irradiance at the distance 1."""
    not_flat = [0.0, 0.0, 0.0, np.inf]
    least_radius = _ROUNDING * extent
    if mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition):
        radius = 0.0
        if is_moving_light(emitter):
            # It may be anywhere in its box
            box = emitter.bbox()
            radius = 0.5 * float(np.linalg.norm(np.array(box.max) - np.array(box.min)))
            p = np.array(box.center(), dtype=np.float64).ravel()
        return [*p, 1.0], not_flat, [radius + least_radius, 1 / (4 * np.pi)]
    is_delta = mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
    if shape is None or is_delta:
        if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
            if is_delta:
                return [*d, 0.0], not_flat, [_ROUNDING, 1 / (np.pi * scene_radius**2)]
            # Light from all directions
            return [0.0] * 4, not_flat, [1.0, 1 / (4 * np.pi * scene_radius**2)]
        # A beam of parallel light, or an unknown emitter: its estimate is never 0
        area = np.pi * scene_radius**2 if shape is None else float(shape.surface_area()[0])
        return [0.0] * 4, not_flat, [1.0, 1 / max(area, 1e-300)]
    center, radius = _bounding_sphere(shape)
    radius += least_radius
    if emitter.class_name() == "AreaLight" and shape.class_name() in ("Rectangle", "Disk"):
        # The reach is the radius: a bound of the cosine, as at the surface that receives
        return [*center, 1.0], [*n, radius], [radius, 1 / np.pi]
    return [*center, 1.0], not_flat, [radius, 1 / (4 * np.pi)]


def _bounding_sphere(shape: mi.Shape) -> tuple[np.ndarray, float]:
    bbox = shape_bounds(shape)
    low, high = np.array(bbox.min, dtype=np.float64), np.array(bbox.max, dtype=np.float64)
    center = 0.5 * (low + high)
    if shape.class_name() == "Sphere":
        return center, float(0.5 * (high - low).max())
    if shape.is_mesh():
        vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        return center, float(np.linalg.norm(vertices - center, axis=1).max(initial=0.0))
    return center, float(0.5 * np.linalg.norm(high - low))
