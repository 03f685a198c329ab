"""Scenes and integrators for tests of the filter of depth of field."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from tests.support.stage import area, film, sensor

EMITTED = {"type": "path", "max_depth": 1}
PATH = {"type": "path", "max_depth": 2}


def ecoc(nested: dict | None = EMITTED, **parameters: Any) -> mi.Integrator:
    children = {"nested": nested} if nested else {}
    return mi.load_dict({"type": "ecoc_dof", **parameters, **children})


def thin_lens(*size: int, **changes: Any) -> dict:
    lens = {"aperture_radius": 0.3, "focus_distance": 4.0}
    return sensor("thinlens", **lens, film=film(*(size or (12, 9)), **changes))


def signs(**changes: Any) -> mi.Scene:
    """A panel near the lens, a disk in focus, lamps far behind: things that only shine."""
    to = mi.ScalarTransform4f

    def across(x: float, y: float, width: float, height: float = 4.0) -> mi.ScalarTransform4f:
        place = to().translate([x, y, 0.6]).rotate([1, 0, 0], 90)
        return place.scale([width / 2, height / 2, 1])

    lamps = {
        f"lamp_{i}": {"type": "rectangle", "to_world": across(x, 8, 0.8), "emitter": area(1.0 + i)}
        for i, x in enumerate(np.arange(-6, 6, 2.0))
    }
    panel = {"type": "rectangle", "to_world": across(-0.9, -2, 1.5), "emitter": area(0.1)}
    disk = {"type": "sphere", "center": [0.9, 0, 0.6], "radius": 0.4, "emitter": area(3.0)}
    camera = thin_lens(48, 32, **changes)
    return mi.load_dict(
        {"type": "scene", "sensor": camera, "panel": panel, "disk": disk, **lamps}, optimize=False
    )


def rendered(scene: mi.Scene, integrator: mi.Integrator, spp: int) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=1))
