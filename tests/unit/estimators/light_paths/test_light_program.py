"""What light paths know of their way, and how it is stored with their vertices."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.bidirectional_programs import LightSums
from mitsuba_ext.estimators.light_paths.light_program import LightProgram
from mitsuba_ext.estimators.light_paths.partial_sums import PartialSums, Sums
from mitsuba_ext.estimators.light_paths.photons.photon_history import (
    PhotonHistory,
    PhotonProgram,
    RegionHistory,
    RegionProgram,
)
from mitsuba_ext.transport.path_decisions import EmitterSampling, SubpathSelection

pytestmark = pytest.mark.usefixtures("variant")


def _light_sums(**parameters: Any) -> LightSums:
    return LightSums(PartialSums(**parameters), EmitterSampling())


def _sums(**more: Any) -> Sums:
    return Sums(mi.Float(2), mi.Float(3), **more)


#: By name, a program, a history of it, and what is read back.
CASES = {
    "nothing": lambda: (LightProgram(), None, None),
    "sums": lambda: (_light_sums(), _sums(), _sums()),
    "split sums": lambda: (
        _light_sums(splits=True),
        *(_sums(by_camera=mi.Vector2f(4, 5), by_kind=mi.Vector2f(6, y)) for y in (7, 0)),
    ),
    "sums with regions": lambda: (
        _light_sums(selection=SubpathSelection()),
        _sums(region=mi.UInt32(8), count=mi.Float(9)),
        Sums(mi.Float(18), mi.Float(3), region=mi.UInt32(8)),
    ),
    "photons": lambda: (PhotonProgram(), *(PhotonHistory(mi.Float(1)) for _ in range(2))),
    "regions": lambda: (
        RegionProgram(SubpathSelection()), *(RegionHistory(mi.UInt32(8)) for _ in range(2))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_is_stored_is_read_back(name: str) -> None:
    program, history, expected = CASES[name]()
    stored = program.stored
    words = stored.words(history)
    assert len(words) == stored.word_count
    assert stored.has_region == (getattr(expected, "region", None) is not None)
    region = history.region if stored.has_region else None
    found = stored.read(words, mi.UInt32(2), region)
    assert type(found) is type(expected)
    for key, value in vars(expected).items() if expected is not None else ():
        if value is not None:
            np.testing.assert_array_equal(np.array(getattr(found, key)), np.array(value))


@pytest.mark.parametrize("name", ["sums", "photons"])
def test_the_first_word_tells_what_came_from_delta_lobes(name: str) -> None:
    of_delta_lobes = {
        "sums": Sums(mi.Float(0), mi.Float(3)),
        "photons": PhotonHistory(mi.Float(0)),
    }
    program, *_ = CASES[name]()
    assert program.stored.words(of_delta_lobes[name])[0] == 0
