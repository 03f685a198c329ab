"""How many samples pilots take, and how much these weigh."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.planning.pilots import doubling_pilots, stage_weights, weights_by_share


@pytest.mark.parametrize("samples", [1, 2, 3, 8, 21, 64])
def test_pilots_double(samples: int) -> None:
    pilots = doubling_pilots(samples)
    assert sum(pilots) == samples and pilots[0] == 1
    assert all(n >= sum(pilots[:i]) for i, n in enumerate(pilots))


@pytest.mark.parametrize("parts", [1, 2, 4])
@pytest.mark.parametrize("spp", [4, 6, 8, 16, 64, 1024])
def test_weights_of_stages_cost_little(spp: int, parts: int) -> None:
    pilots = doubling_pilots(max(1, min(spp // 4, 64)))
    stages = [*pilots, spp - sum(pilots)]
    weights = np.array(stage_weights(stages, parts))
    assert len(weights) == len(stages) + parts - 1
    assert weights[-1] == 1 and (weights > 0).all() and (np.diff(weights) >= 0).all()
    # In each part of the pixels, the first stage has another weight
    sizes = [2.0 ** -(parts - max(1, part)) if parts > 1 else 1 for part in range(parts)]
    loss = 0.0
    for part, size in enumerate(sizes):
        w = np.array([weights[part], *weights[parts:]])
        loss += size * (np.sum(stages) * (stages * w**2).sum() / (stages * w).sum() ** 2 - 1)
    assert sum(sizes) == 1 and loss < 0.0151
    assert stage_weights([5]) == [1]


@pytest.mark.parametrize("stages", [(1, 1, 2, 12), (8, 8, 16, 224), (2, 2, 8, 20, 480)])
def test_pilots_weigh_less_the_less_their_stage_has_learned(stages: tuple[int, ...]) -> None:
    weights = np.array(weights_by_share(stages))
    assert weights[-1] == 1 and (weights >= 0).all() and (np.diff(weights) > 0).all()
    mean = (stages * weights).sum()
    assert np.sum(stages) * (stages * weights**2).sum() / mean**2 < 1.0151
    assert weights_by_share([5]) == [1]
