"""The voxel-to-voxel visibility map of NEE++.

Source: Guo, Eisemann and Eisemann, *Next Event Estimation++*, CGF 39(7), 2020, sections 3.1-3.2
(= Guo's thesis, section 3.3).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.regions.voxel_grid import VoxelGrid
from ...util.arrays import from_numpy
from ...util.stored_arrays import StoredArrays

#: Two counters, and two numbers of the roulette's table in the worst case (lights in all voxels).
_BYTES_PER_ENTRY = 16

#: The most rays of a refinement.
_MAX_REFINEMENT = 1 << 22

#: With more voxels, intermediate results of the numbers of entries would exceed 32 bits.
MAX_VOXELS = 0xFFFF

#: The grid's table of voxel numbers, and the marks from which it is built.
_BYTES_PER_CELL = 8

#: Length of the test segments of :meth:`VisibilityMap.refine`, short of the end point.
_SEGMENT = 1 - 1e-4


class VisibilityMap:
    """Counts, for each pair of occupied voxels, how many segments between them were unoccluded.

    The map is symmetric, so the lower triangle is stored. Counters are integers, so that the same
    samples give bitwise the same map.

    Parameters:
        scene: The scene to learn.
        grid: Voxels along each axis of the scene's bounding box.
        max_memory: The most bytes that the map may take. If ``grid`` needs more, a coarser grid is
            used, with a warning.

    Attributes:
        voxels: The grid.
        tests, successes (mi.UInt32): The counters, one for each entry.
    """

    def __init__(self, scene: mi.Scene, grid: int, max_memory: int) -> None:
        # The grid's own tables count too: they bound the resolution before anything is allocated
        resolution = min(grid, max(1, int((max_memory / _BYTES_PER_CELL) ** (1 / 3))))
        self.voxels = VoxelGrid(scene, resolution)
        while self._memory() > max_memory or self.voxels.occupied_count > MAX_VOXELS:
            if self.voxels.resolution == 1:
                break
            self.voxels = VoxelGrid(scene, int(0.8 * self.voxels.resolution))
        if self.voxels.resolution < grid:
            mi.Log(
                mi.LogLevel.Warn,
                f"The visibility map of grid={grid} would exceed max_memory="
                f"{max_memory / 2**20:g} MiB: grid={self.voxels.resolution} is used.",
            )
        entries = self._entry_count()
        self.tests = dr.zeros(mi.UInt32, entries)
        self.successes = dr.zeros(mi.UInt32, entries)
        self._holds_light = dr.zeros(mi.UInt32, self.voxels.occupied_count)

    def state(self) -> dict[str, np.ndarray]:
        """The counters as arrays."""
        return {
            "tests": self.tests.numpy(),
            "successes": self.successes.numpy(),
            "holds_light": self._holds_light.numpy(),
        }

    def restore(self, state: StoredArrays) -> None:
        """Takes over the counters of a map of the same scene and grid.

        Raises:
            DamagedError: They are no such counters.
        """
        entries, most = (len(self.tests),), 0xFFFFFFFF
        tests, successes = (
            state.take(key, "u", entries, 0, most, *entries) for key in ("tests", "successes")
        )
        state.require(bool((successes <= tests).all()), 'there are more "successes" than "tests"')
        holds_light = state.take("holds_light", "u", (len(self._holds_light),), most=1)
        self.tests, self.successes, self._holds_light = (
            from_numpy(mi.UInt32, x) for x in (tests, successes, holds_light)
        )

    def _entry_count(self) -> int:
        n = self.voxels.occupied_count
        return n * (n + 1) // 2

    def _memory(self) -> int:
        cells = self.voxels.resolution**3
        return self._entry_count() * _BYTES_PER_ENTRY + cells * _BYTES_PER_CELL

    def entry(self, p: mi.Point3f, q: mi.Point3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """The index of the pair of voxels that hold ``p`` and ``q``, and whether it exists (not for
        points at infinity and in voxels without geometry)."""
        i, i_known = self.voxels.index(p, active)
        j, j_known = self.voxels.index(q, active)
        return self.entry_of(i, j), i_known & j_known

    def entry_of(self, i: mi.UInt32, j: mi.UInt32) -> mi.UInt32:
        """The index of a pair of voxels, in either order."""
        row, column = dr.maximum(i, j), dr.minimum(i, j)
        return row * (row + 1) // 2 + column

    # ---- Observations of the walk ----

    def shadow_ray(self, p: mi.Point3f, q: mi.Point3f, visible: mi.Bool, active: mi.Bool) -> None:
        """Records a shadow ray that was traced from ``p`` to the point ``q`` on a light."""
        entry, known = self.entry(p, q, active)
        self._count(entry, visible, known)
        light_voxel, known = self.voxels.index(q, known)
        dr.scatter(self._holds_light, mi.UInt32(1), light_voxel, known)

    def segment(self, p: mi.Point3f, q: mi.Point3f, active: mi.Bool) -> None:
        """Records a path segment from ``p`` to ``q``: the points see each other."""
        entry, known = self.entry(p, q, active)
        self._count(entry, mi.Bool(True), known)

    def _count(self, entry: mi.UInt32, visible: mi.Bool, active: mi.Bool) -> None:
        dr.scatter_add(self.tests, mi.UInt32(1), entry, active)
        dr.scatter_add(self.successes, mi.UInt32(1), entry, active & visible)

    # ---- Between the stages ----

    def refine(self, scene: mi.Scene, test_count: int) -> None:
        """Adds ``test_count`` random tests to the entries in which a success was seen (section
        3.2): segments between uniform random points of the two voxels. Only entries of a voxel
        with a light are refined, since next event estimation asks for no others. Where these are
        very many, each gets fewer tests."""
        entry = dr.compress(self.successes > 0)
        if len(entry) == 0:
            return
        i, j = _row_and_column(entry)
        lit = dr.gather(mi.UInt32, self._holds_light, i) > 0
        lit |= dr.gather(mi.UInt32, self._holds_light, j) > 0
        entry = dr.gather(mi.UInt32, entry, dr.compress(lit))
        test_count = min(test_count, _MAX_REFINEMENT // max(1, len(entry)))
        if test_count == 0 or len(entry) == 0:
            return
        lane = dr.arange(mi.UInt32, len(entry) * test_count)
        entry = dr.gather(mi.UInt32, entry, lane // test_count)
        i, j = _row_and_column(entry)
        rng = mi.PCG32(size=len(lane))

        def uniform() -> mi.Point3f:
            return mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())

        p, q = self.voxels.point(i, uniform()), self.voxels.point(j, uniform())
        ray = mi.Ray3f(p, q - p, _SEGMENT, 0.0, dr.zeros(mi.Ray3f).wavelengths)
        self._count(entry, ~scene.ray_test(ray), mi.Bool(True))
        dr.eval(self.tests, self.successes)

    # ---- What was learned ----

    def light_voxels(self) -> mi.UInt32:
        """The voxels in which shadow rays ended."""
        return dr.compress(self._holds_light > 0)

    def test_count(self, entry: mi.UInt32) -> mi.UInt32:
        """The number of segments that were tested."""
        return dr.gather(mi.UInt32, self.tests, entry)

    def ratio(self, entry: mi.UInt32) -> mi.Float:
        """The share of the tests that succeeded; 0 where there was none."""
        tests = dr.gather(mi.UInt32, self.tests, entry)
        successes = dr.gather(mi.UInt32, self.successes, entry)
        return mi.Float(successes) / mi.Float(dr.maximum(tests, 1))

    def posterior_mean(self, entry: mi.UInt32) -> mi.Float:
        """The probability that two points of the pair of voxels see each other: the mean of a Beta
        posterior. Its prior has the weight of one test, and the share of successes in the whole map
        as its mean."""
        tests, successes = (int(dr.sum(mi.UInt64(n))[0]) for n in (self.tests, self.successes))
        # Half a success in one more test keeps the prior from being 0 or 1
        prior = dr.opaque(mi.Float, (successes + 0.5) / (tests + 1))
        tests = mi.Float(dr.gather(mi.UInt32, self.tests, entry))
        successes = mi.Float(dr.gather(mi.UInt32, self.successes, entry))
        return (successes + prior) / (tests + 1)

    def __str__(self) -> str:
        seen, succeeded = (int(dr.count(n > 0)[0]) for n in (self.tests, self.successes))
        return (
            f"visibility map: grid {self.voxels.resolution}, {self.voxels.occupied_count} occupied "
            f"voxels, {self._entry_count()} entries ({seen} seen, {succeeded} with a success), "
            f"{self._memory() / 2**20:.1f} MiB"
        )


def _row_and_column(entry: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Inverts ``entry = row (row + 1) / 2 + column``."""
    row = mi.UInt32(dr.sqrt(2 * mi.Float(entry)))
    # The square root is rounded: the exact row is at most one off
    row[row * (row + 1) // 2 > entry] -= 1
    row[(row + 1) * (row + 2) // 2 <= entry] += 1
    return row, entry - row * (row + 1) // 2
