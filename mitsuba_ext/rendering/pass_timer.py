"""Times passes, and counts their kernels."""

from __future__ import annotations

import time

import drjit as dr


def kernel_cache_misses() -> int:
    """The number of kernels that this process has compiled, or loaded from the disk."""
    _launches, soft_misses, hard_misses = dr.detail.launch_stats()
    return soft_misses + hard_misses


class PassTimer:
    """Times a pass from now on."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self._misses, self._compiled = kernel_cache_misses(), _kernels_compiled()

    @property
    def seconds(self) -> float:
        """Seconds since the pass began."""
        return time.perf_counter() - self._begin

    @property
    def has_compiled(self) -> bool:
        """Whether kernels have been compiled since then: they were in no cache."""
        return _kernels_compiled() > self._compiled

    @property
    def has_new_kernels(self) -> bool:
        """Whether kernels have been compiled since then, or loaded from the disk. If so, the time
        does not tell the speed."""
        return kernel_cache_misses() > self._misses


def _kernels_compiled() -> int:
    return dr.detail.launch_stats()[2]
