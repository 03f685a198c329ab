"""Random scenes: a few of those that ``python tests/fuzz.py`` tries by the hundred."""

from __future__ import annotations

import pytest
from fuzz import failures, some_techniques

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

#: With two techniques each, all have their turn.
SCENES = range(7)


@pytest.mark.parametrize("scene", SCENES)
def test_random_scenes_are_those_of_path(scene: int):
    found = list(failures(scene, some_techniques(scene, 2)))
    assert not found, "\n".join(map(str, found))
