"""Closed scenes with an exact answer: path lengths and MIS weights add up."""

from __future__ import annotations

import pytest

from tests.support.furnaces import FURNACES, check_furnace
from tests.support.technique import FURNACES as NAMES
from tests.support.techniques import REFERENCE, TECHNIQUES, pairs

pytestmark = pytest.mark.usefixtures("variant")


def _has_answer(furnace: str, max_depth: int) -> bool:
    return any(region.exact(max_depth) is not None for region in FURNACES[furnace].regions)


def test_every_furnace_is_in_the_table() -> None:
    assert set(FURNACES) == set(NAMES)


@pytest.mark.parametrize(
    ("furnace", "max_depth", "name"),
    [case for case in pairs("furnaces", "depths") if _has_answer(*case.values[:2])],
)
def test_furnace_has_the_exact_radiance(furnace: str, max_depth: int, name: str) -> None:
    # Where nine of ten shadow rays are rejected, there is noise; and where light paths miss things
    precision = 0.01 if TECHNIQUES[name].parameters.get("floor") else 0.002
    precision = 0.02 if name == "light_tracer" else precision
    check_furnace(furnace, TECHNIQUES[name], max_depth, precision)


@pytest.mark.slow
@pytest.mark.parametrize("furnace", FURNACES)
def test_path_has_the_exact_radiance(furnace: str) -> None:
    """The answers themselves, checked once against Mitsuba."""
    check_furnace(furnace, REFERENCE, -1)
