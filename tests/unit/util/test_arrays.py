"""Arrays of Dr.Jit that are made from others."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.util.arrays import from_numpy

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.parametrize("name", ["Float", "Float64", "UInt32", "UInt64", "Int32", "Bool"])
def test_numbers_of_numpy_are_kept_in_a_row(name: str) -> None:
    kind = getattr(mi, name)
    values = np.arange(6).reshape(2, 3) % 2
    found = from_numpy(kind, values.T)
    assert type(found) is kind
    assert np.array_equal(found.numpy(), values.T.ravel())


def test_memory_of_numpy_is_aligned() -> None:
    memory = np.arange(64, dtype=np.float32)
    for start in range(8):
        # Without a copy in between: this is the memory that kernels read
        found = from_numpy(mi.Float, memory[start : start + 16]).numpy()
        assert found.ctypes.data % 64 == 0
        assert np.array_equal(found, memory[start : start + 16])


def test_empty_arrays_stay_empty() -> None:
    assert dr.width(from_numpy(mi.UInt32, [])) == 0
