"""Seeds that are learned: where chains from nearby vertices to nearby targets have begun.

Source: Z. Fan, P. Hong, J. Guo, C. Zou, Y. Guo, L.-Q. Yan, *Manifold Path Guiding for Importance
Sampling Specular Chains*, SIGGRAPH Asia 2023. Ours differs in this: seeds lie in a tree over
vertices and targets, and a fixed share of trials ignores them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ....util.arrays import from_numpy
from ....util.stored_arrays import StoredArrays
from .solver import Target

#: Seeds in each leaf, and the most leaves: 2 MiB of seeds.
_PER_LEAF, _MOST_LEAVES = 32, 4096
#: The number of recorded chains for each leaf, at least. With 8, chains that the pilots have missed
#: become rarer: the variance in caustic is 1.5 times as large.
_RECORDS_PER_LEAF = 16

#: The share of trials that begin at a learned seed.
_SHARE = 0.5

#: The coordinates of a record: vertex and target.
_DIMENSIONS = 6

#: The patterns of chains: length · 4 + the bits of the surfaces that transmit.
_PATTERNS = (4, 5, 11)
_NO_SPLITS, _NO_SEEDS = np.zeros((0, 2), np.float32), np.zeros((0, _PER_LEAF, 4), np.float32)


class SeedMap:
    """A tree whose leaves hold seeds: the first points of chains on casters, and the pattern of
    each chain. The tree splits the coordinates of vertices and targets.

    Its arrays always have the same size, and its kernels are the same before anything was learned:
    the share of trials that begin at its seeds is then 0.
    """

    def __init__(self, splits: np.ndarray = _NO_SPLITS, seeds: np.ndarray = _NO_SEEDS) -> None:
        """
        Args:
            splits: For each inner node, the root first, the coordinate and its value; shape
                [leaves - 1, 2].
            seeds: Shape [leaves, _PER_LEAF, 4]; no leaves before anything was learned.
        """
        self.splits, self.seeds = splits, seeds
        nodes = np.zeros((_MOST_LEAVES, 2), np.float32)
        leaves = np.zeros((_MOST_LEAVES, _PER_LEAF, 4), np.float32)
        nodes[1 : len(splits) + 1], leaves[: len(seeds)] = splits, seeds
        self._nodes, self._leaves = from_numpy(mi.Float, nodes), from_numpy(mi.Float, leaves)
        self._leaf_count = dr.opaque(mi.UInt32, len(splits) + 1)
        self._share = dr.opaque(mi.Float, _SHARE if len(seeds) else 0.0)

    def kernel_state(self) -> tuple:
        """The attributes on which kernels depend (``frozen.py``)."""
        return self._nodes, self._leaves, self._leaf_count, self._share

    @dr.syntax
    def leaf(self, p: mi.Point3f, target: Target, active: mi.Bool) -> mi.UInt32:
        """The leaf of a vertex at ``p`` and a target; 0 where not ``active``."""
        leaf_count = self._leaf_count
        node = dr.select(active, mi.UInt32(1), leaf_count)
        while node < leaf_count:
            split = dr.gather(mi.Point2f, self._nodes, node)
            axis = mi.UInt32(split.x)
            x = mi.Float(target.p.z)
            for i, other in enumerate((p.x, p.y, p.z, target.p.x, target.p.y)):
                x = dr.select(axis == i, other, x)
            node = 2 * node + dr.select(x < split.y, mi.UInt32(0), 1)
        return node - leaf_count

    def is_used(self, u: mi.Float) -> mi.Bool:
        """Whether a trial with the random number ``u`` begins at a seed."""
        return u < self._share

    def is_left_out(self, u: mi.Float) -> mi.Bool:
        """Whether a trial with this number belongs to the second half of the others."""
        return u >= 0.5 * (1 + self._share)

    def seed(self, leaf: mi.UInt32, u: mi.Float, v: mi.Float) -> tuple[mi.Point3f, mi.UInt32]:
        """A seed of a leaf, or of one of the nodes above it: a point on a caster, and length · 4 +
        the bits of the surfaces that transmit.

        Args:
            u, v: Uniform numbers, for the seed and the node: each node above has half the
                probability of the one below it."""
        height = mi.UInt32(-dr.log2(1 - v))
        leaves = dr.minimum(mi.UInt32(1) << height, self._leaf_count)
        count = leaves * _PER_LEAF
        place = dr.minimum(mi.UInt32(u * mi.Float(count)), count - 1)
        index = (leaf & ~(leaves - 1)) * _PER_LEAF + place
        words = dr.gather(mi.Vector4f, self._leaves, index)
        return mi.Point3f(words.x, words.y, words.z), mi.UInt32(words.w)

    # ---- Learning ----

    @classmethod
    def of(cls, records: np.ndarray) -> SeedMap:
        """The seeds of chains that were found.

        Args:
            records: Vertex, target, first point on a caster, pattern, and weight of each chain;
                shape [chains, 11].
        """
        depth = int(np.log2(max(1, min(len(records) // _RECORDS_PER_LEAF, _MOST_LEAVES))))
        # Each record becomes seeds in proportion to its weight
        size = _PER_LEAF << depth
        ends = records[:, -1].cumsum(dtype=np.float64)
        places = np.searchsorted(ends, (np.arange(size) + 0.5) / size * ends[-1])
        nodes = records[np.minimum(places, len(records) - 1), :-1][None]
        splits = [_NO_SPLITS]
        for _level in range(depth):
            # Each node splits its records into halves along the axis in which they differ most
            coordinates = nodes[:, :, :_DIMENSIONS]
            axis = (coordinates.max(1) - coordinates.min(1)).argmax(1)
            along = np.take_along_axis(coordinates, axis[:, None, None], 2)[:, :, 0]
            order = np.argsort(along, axis=1, kind="stable")
            nodes = np.take_along_axis(nodes, order[:, :, None], 1)
            half = nodes.shape[1] // 2
            values = np.take_along_axis(along, order[:, half : half + 1], 1)[:, 0]
            splits.append(np.stack([axis, values], -1))
            nodes = nodes.reshape(2 * len(nodes), half, -1)
        return cls(np.concatenate(splits).astype(np.float32), nodes[:, :, _DIMENSIONS:])

    def state(self) -> dict[str, np.ndarray]:
        """Its arrays, for :meth:`restored`."""
        return {"splits": self.splits, "seeds": self.seeds}

    @classmethod
    def restored(cls, state: StoredArrays) -> SeedMap:
        """The map with this :meth:`state`."""
        seeds = state.take("seeds", "f", (None, _PER_LEAF, 4))
        count = len(seeds)
        is_power = count <= _MOST_LEAVES and count & (count - 1) == 0
        state.require(is_power, f"with {count} leaves of seeds")
        patterns = bool(np.isin(seeds[:, :, 3], _PATTERNS).all())
        state.require(patterns, "with seeds of unknown patterns")
        splits = state.take("splits", "f", (max(count - 1, 0), 2))
        state.require(bool(np.isin(splits[:, 0], range(_DIMENSIONS)).all()), "with unknown axes")
        return cls(splits, seeds)
