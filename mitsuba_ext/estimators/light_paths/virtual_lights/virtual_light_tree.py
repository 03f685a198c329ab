"""Choosing virtual lights by a light tree: a stochastic light cut of one light.

Each set has a complete binary tree over its virtual lights, sorted along a space-filling curve. A
choice goes down from the root, and takes a child with a probability proportional to an estimate of
what its virtual lights contribute: their flux, times a geometry term between the vertex and the
bounding sphere of the child, at most the bound. The estimate is not 0 where there is flux, so a
wrong estimate causes noise, but no bias.

Source: B. Walter et al., *Lightcuts: A Scalable Approach to Illumination*, ACM Transactions on
Graphics 24(3), 2005 (the tree, and the bounds of cosines and distances); A. Conty Estevez,
C. Kulla, *Importance Sampling of Many Lights with Adaptive Tree Splitting*, HPG 2018 (going down
at random).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....scene.regions.surface_voxels import lit_normal
from ....util.arrays import from_numpy
from ..vertex_choice import Chosen
from .virtual_light_choice import emitted_flux
from .virtual_lights import VirtualLights

#: Added to estimated cosines, so that none is 0: BSDFs may transmit light, and shading normals may
#: differ from geometric normals.
_LEAST_COSINE = 0.05

#: Numbers of a node: centre and radius of the sphere, mean normal, flux.
_WORDS = 8

#: Bits of each coordinate on the curve.
_CURVE_BITS = 16


class ClusteredChoice:
    """Chooses a virtual light of the lane's set by the tree.

    Parameters:
        lights: The virtual lights.
        set_index: The set of each lane.
        largest: The bound of the geometry term.
    """

    is_stratified = True

    def __init__(self, lights: VirtualLights, set_index: mi.UInt32, largest: mi.Float) -> None:
        self._share, self._largest = lights.share, largest
        nodes, leaf = _trees(lights)
        self._levels = leaf.shape[1].bit_length() - 1
        self._nodes, self._leaf = from_numpy(mi.Float, nodes), from_numpy(mi.UInt32, leaf)
        # Each half of the way down takes its own random number, because one has only 24 bits
        self._half, self._depth = (
            dr.opaque(mi.UInt32, n) for n in ((self._levels + 1) // 2, self._levels)
        )
        self._root = mi.UInt32(set_index) * (2 << self._levels)
        self._first = mi.UInt32(set_index) << self._levels
        self._number = dr.gather(mi.UInt32, lights.number, set_index)
        dr.eval(self._root, self._first, self._number)

    def numbers(self, sampler):
        return (sampler.next_2d(),)

    @dr.syntax
    def choose(self, numbers, vertex, active):
        si = vertex.si
        p, n = si.p, dr.mulsign(si.sh_frame.n, si.wi.z)
        transmits = mi.has_flag(vertex.bsdf.flags(), mi.BSDFFlags.Transmission)
        node, level, probability = mi.UInt32(1), mi.UInt32(0), mi.Float(1)
        x = mi.Float(numbers[0].x)
        goes_down = active & (self._number > 0)
        exists = mi.Bool(goes_down)
        while dr.hint(goes_down & (level < self._depth), label="light tree"):
            x = dr.select(level == self._half, numbers[0].y, x)
            left = self._estimate(2 * node, p, n, transmits, goes_down)
            right = self._estimate(2 * node + 1, p, n, transmits, goes_down)
            total = left + right
            goes_down &= total > 0
            share = dr.select(goes_down, left / total, 1)
            is_left = x < share
            chosen = dr.select(is_left, share, 1 - share)
            x = dr.select(is_left, x / share, (x - share) / (1 - share))
            x = dr.minimum(x, dr.one_minus_epsilon(mi.Float))
            probability *= chosen
            node = 2 * node + dr.select(is_left, mi.UInt32(0), 1)
            level += 1
        exists &= goes_down & (probability > 0)
        index = dr.gather(
            mi.UInt32, self._leaf, self._first + node - (1 << self._levels), exists
        )
        return Chosen(index, self._share / dr.select(exists, probability, 1), exists)

    def _estimate(self, node, p, n, transmits, active) -> mi.Float:
        """What the virtual lights of a node contribute to a vertex."""
        w = dr.gather(
            mi.ArrayXf, self._nodes, self._root + node, active, shape=(_WORDS, dr.width(active))
        )
        d = mi.Vector3f(w[0], w[1], w[2]) - p
        radius, flux, axis = w[3], w[7], mi.Vector3f(w[4], w[5], w[6])
        # The estimated distance of a node is at least its radius
        squared = dr.maximum(dr.squared_norm(d), dr.square(radius))
        inverse = dr.rsqrt(dr.maximum(squared, 1e-30))
        received = dr.dot(n, d)
        received = dr.select(transmits, dr.abs(received), received)
        received = dr.clip((received + radius) * inverse, 0, 1)
        # A mean normal of length 1 is the normal of all lights; one of length 0 says nothing
        emitted = -dr.dot(axis, d) * inverse + (1 - dr.norm(axis)) * 0.5 + radius * inverse
        emitted = dr.clip(emitted, 0, 1)
        G = (received + _LEAST_COSINE) * (emitted + _LEAST_COSINE) * dr.square(inverse)
        return flux * dr.minimum(G, self._largest)


def _trees(lights: VirtualLights) -> tuple[np.ndarray, np.ndarray]:
    """The trees of all sets: nodes like a heap, from 1 (shape [sets, 2 leaves, words]), and the
    virtual light of each leaf (shape [sets, leaves])."""
    vertices, sets = lights.vertices, lights.set_count
    active = dr.full(mi.Bool, True, vertices.count)
    vertex = vertices.at(dr.arange(mi.UInt32, vertices.count), active)
    normal, flux = lit_normal(vertex.si), emitted_flux(lights)
    # Light leaves on both sides
    transmits = mi.has_flag(vertex.si.bsdf().flags(), mi.BSDFFlags.Transmission)
    normal = dr.select(transmits, 0, normal)
    position = mi.Point3f(vertex.si.p)
    dr.eval(position, normal)
    p, n = position.numpy().T, normal.numpy().T
    number = lights.number.numpy().astype(np.int64)
    owner = np.repeat(np.arange(sets), number)
    order = np.lexsort((_along_curve(p), owner))
    place = np.arange(len(order)) - np.repeat(np.cumsum(number) - number, number)
    leaves = 1 << max(1, int(number.max(initial=1)) - 1).bit_length()

    leaf = np.zeros((sets, leaves), np.uint32)
    leaf[owner, place] = order
    nodes = np.zeros((sets, 2 * leaves, _WORDS), np.float32)
    low, high = (np.full((sets, leaves, 3), x, np.float32) for x in (np.inf, -np.inf))
    low[owner, place] = high[owner, place] = p[order]
    axis, power = np.zeros((sets, leaves, 3)), np.zeros((sets, leaves))
    power[owner, place] = flux[order]
    axis[owner, place] = n[order] * flux[order, None]
    width = leaves
    while True:
        level = nodes[:, width : 2 * width]
        # Boxes around nothing are inside out
        is_used = (low <= high).all(axis=-1, keepdims=True)
        corners = np.where(is_used, low, 0), np.where(is_used, high, 0)
        level[..., 0:3] = 0.5 * (corners[0] + corners[1])
        extent = corners[1] - corners[0]
        level[..., 3] = 0.5 * np.linalg.norm(extent, axis=-1)
        level[..., 4:7] = axis / np.maximum(power, 1e-300)[..., None]
        level[..., 7] = power
        if width == 1:
            return nodes, leaf
        width //= 2
        low = np.minimum(low[:, ::2], low[:, 1::2])
        high = np.maximum(high[:, ::2], high[:, 1::2])
        axis, power = axis[:, ::2] + axis[:, 1::2], power[:, ::2] + power[:, 1::2]


def _along_curve(p: np.ndarray) -> np.ndarray:
    """The places of points on a Z-shaped curve through their bounding cube."""
    finite = np.where(np.isfinite(p), p, 0)
    low = finite.min(axis=0, initial=np.inf)
    size = max(float((finite - low).max(initial=0)), 1e-30)
    cell = ((finite - low) / size * ((1 << _CURVE_BITS) - 1)).astype(np.uint64)
    code = np.zeros(len(p), np.uint64)
    for bit in range(_CURVE_BITS):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code
