"""Choosing lights by their estimated contributions, one by one or in a tree."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest

from mitsuba_ext.techniques.linear_lights.linear_lights import LinearChoice
from mitsuba_ext.transport.path_decisions import EmitterSampling
from mitsuba_ext.transport.tree_choice import tree_choice
from tests.support.light_choices import LANES, counts_at, floor, point, select, vertex_at
from tests.support.stage import diffuse

pytestmark = pytest.mark.usefixtures("variant")

Choice = Callable[..., EmitterSampling]


@pytest.mark.parametrize("choice", [LinearChoice, tree_choice])
def test_sampling_weight_is_a_factor(choice: Choice) -> None:
    scene = floor(
        diffuse(),
        three=point(0, 0.5, 1, sampling_weight=3.0),
        one=point(0, -0.5, 1),
        none=point(0, 0, 0.5, sampling_weight=0.0),
    )
    counts = counts_at(choice(scene), scene)
    assert counts["three"] / counts["one"] == pytest.approx(3, rel=0.05)
    assert counts["none"] == 0


# Exact probabilities have no variance. Estimates of single lights come close to them; estimates of
# groups of lights are wrong by about half
@pytest.mark.parametrize(("choice", "deviation"), [(LinearChoice, 0.3), (tree_choice, 1.2)])
def test_a_thousand_lamps_estimate_the_sum_of_a_thousand_lamps(
    choice: Choice, deviation: float
) -> None:
    rng = np.random.default_rng(1)
    positions = rng.uniform([-2, -2, -1], [2, 2, 3], (1000, 3))
    intensities = 10 ** rng.uniform(-2, 2, 1000)
    lamps = {
        f"p{i:04}": point(*p, intensity=w)
        for i, (p, w) in enumerate(zip(positions.tolist(), intensities.tolist()))
    }
    scene = floor(diffuse(), **lamps)
    si = vertex_at(scene, [0.5, 0, 1], [0, 0, 0])
    ds, weight, _state = select(choice(scene), scene, si)
    value = (weight.x * dr.maximum(si.to_local(ds.d).z, 0)).numpy().astype(np.float64)
    d2 = (positions**2).sum(axis=1)
    exact = (intensities * np.maximum(positions[:, 2], 0) / d2**1.5).sum()
    assert abs(value.mean() - exact) < 4 * value.std() / np.sqrt(LANES)
    assert value.std() < deviation * exact
