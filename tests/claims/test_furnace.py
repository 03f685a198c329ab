"""Closed scenes whose radiance is known exactly: path lengths and MIS weights add up."""

from __future__ import annotations

import pytest

from tests.support.furnaces import FURNACES, check_furnace
from tests.support.techniques import REFERENCE, TECHNIQUES, pairs

pytestmark = pytest.mark.usefixtures("variant")


def _has_answer(furnace: str, max_depth: int) -> bool:
    return any(region.exact(max_depth) is not None for region in FURNACES[furnace].regions)


@pytest.mark.parametrize(
    ("furnace", "max_depth", "name"),
    [case for case in pairs("furnaces", "depths") if _has_answer(*case.values[:2])],
)
def test_furnace_has_the_exact_radiance(furnace: str, max_depth: int, name: str) -> None:
    # Rejecting nine of ten shadow rays makes noise, and so do objects that light paths miss
    precision = 0.01 if TECHNIQUES[name].parameters.get("floor") else 0.002
    precision = 0.02 if name == "light_tracer" else precision
    check_furnace(furnace, TECHNIQUES[name], max_depth, precision)


@pytest.mark.slow
@pytest.mark.parametrize("furnace", FURNACES)
def test_path_has_the_exact_radiance(furnace: str) -> None:
    """The exact answers agree with Mitsuba."""
    check_furnace(furnace, REFERENCE, -1)
