"""``bdpt``, and the comparison of its image with the image of ``path``."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_quarters,
    batches,
)


def bdpt(max_depth: int = 4, **parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "bdpt", "max_depth": max_depth, **parameters})


def assert_image_of_path(
    scene: mi.Scene | dict[str, Any],
    max_depth: int = 4,
    spp: int = 256,
    precision: float = 0.005,
    reference: str = "path",
    both: dict[str, Any] | None = None,
    **parameters: Any,
) -> None:
    """The means of the image and of its quarters agree with ``path``."""
    if isinstance(scene, dict):
        scene = mi.load_dict(scene, optimize=False)
    other = mi.load_dict({"type": reference, "max_depth": max_depth, **(both or {})})
    integrator = bdpt(max_depth, **(both or {}), **parameters)
    images = batches(scene, integrator, spp, SEEDS[:MANY_SEEDS])
    expected = batches(scene, other, 2 * spp, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision)
