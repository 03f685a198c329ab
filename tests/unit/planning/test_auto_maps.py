"""Maps of the numbers of camera rays in ``auto_path``, and passes from which maps are learned."""

from __future__ import annotations

import mitsuba as mi
import pytest

from mitsuba_ext.rendering.plan import Learning, RenderPlan
from tests.support.statistical import assert_same_image, batches, load

pytestmark = pytest.mark.usefixtures("variant")


def test_auto_path_uses_maps_of_times_where_they_pay() -> None:
    scene = load("six_balls", width=96, height=54)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 2})
    noise = batches(scene, plain, 64, [1, 2]).var(axis=0).mean()
    integrator = mi.load_dict({"type": "auto_path", "max_depth": 2})
    ours = batches(scene, integrator, 64, [1, 2]).var(axis=0).mean()
    assert "times" in integrator.statistics.learned
    assert ours < 0.4 * noise  # a tenth


@pytest.mark.slow
def test_auto_path_is_the_same_where_no_ray_has_such_numbers() -> None:
    """Also the weights of stages."""
    scene = load("cornell_box", width=32, height=18)
    words = {"directions": "guided", "next_event": "contribution"}
    images = [
        batches(scene, mi.load_dict({**plugin, "max_depth": 4}), 32, [3])[0]
        for plugin in ({"type": "auto_path"}, {"type": "composed_path", **words})
    ]
    assert_same_image(*images)


def test_passes_from_which_maps_are_learned_are_short_in_large_films() -> None:
    pixels = 1920 * 1080
    plan = RenderPlan(0, 64, (32, 32), Learning(), pixels, False, 16, 1)
    assert plan.pass_length(32) == 16
    assert plan.pass_length(32, 2 * pixels + 1) == 2
    assert plan.pass_length(32, pixels // 2) == 1
    assert RenderPlan(0, 64, (32, 32), Learning(), pixels, True, 8, 1).pass_length(32, pixels) == 8
