"""Small renders in batches: a scene, the integrator ``variance`` around another, and its film."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mitsuba_ext.rendering.batches import Batches, each_batch
from tests.support.stage import film, sensor, stage


def with_variance(nested: str | dict = "path", batches: int = 4, **parameters) -> mi.Integrator:
    inner = {"type": nested} if isinstance(nested, str) else nested
    return mi.load_dict({"type": "variance", "batches": batches, "nested": inner, **parameters})


def small_scene(*size: int, sampler: str = "independent", **changes) -> mi.Scene:
    return mi.load_dict(stage(camera=sensor(film=film(*size, **changes), sampler=sampler)))


def film_channels(scene: mi.Scene) -> dict[str, np.ndarray]:
    bitmap = scene.sensors()[0].film().bitmap()
    pixels = np.array(bitmap)
    return {field.name: pixels[..., index] for index, field in enumerate(bitmap.struct_())}


def render_batches(*arguments) -> Batches:
    *_, batches = each_batch(*arguments)
    return batches
