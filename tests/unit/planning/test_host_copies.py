"""Learning reads decisions from the device, not images or records: each copy waits for a GPU."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from tests.support.paths import ROOT


@pytest.fixture
def copied(monkeypatch) -> list[int]:
    """The sizes of all copies to NumPy, in bytes."""
    sizes = []

    def counted(method: Any) -> Any:
        def copy(*arguments: Any, **keywords: Any) -> Any:
            result = method(*arguments, **keywords)
            sizes.append(result.nbytes)
            return result

        return copy

    for name in ("numpy", "__array__"):
        monkeypatch.setattr(dr.ArrayBase, name, counted(getattr(dr.ArrayBase, name)))
    return sizes


@pytest.mark.slow
@pytest.mark.usefixtures("variant")
def test_no_copy_of_learned_lights_grows_with_the_film(copied: list[int]) -> None:
    """An image of the larger film has 81 KiB in single precision."""
    largest, total = [], []
    for width, height in ((96, 54), (192, 108)):
        scene = mi.load_file(str(ROOT / "scenes" / "rooms.xml"), width=width, height=height)
        integrator = mi.load_dict({"type": "neepp", "max_depth": 6})
        copied.clear()
        mi.render(scene, integrator=integrator, spp=64)
        assert "less variance" in integrator.statistics.learned
        largest.append(max(copied))
        total.append(sum(copied))
    # A light tree is built on the host
    assert max(largest) < 65_536 and total[1] < 1.1 * total[0] < 1_000_000, (largest, total)
