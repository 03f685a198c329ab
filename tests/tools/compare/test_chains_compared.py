"""``compare`` and ``variance`` are fair to chains: samples of a chain, and pixels of an image,
depend on each other, so that only the spread between seeds tells how uncertain an image is."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import compare
from tests.support.batched import with_variance
from tests.support.noisy import compare_noisy, noisy_integrator
from tests.support.stage import stage
from tests.support.statistical import batches

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.usefixtures("without_report")
def test_noise_that_all_pixels_share_widens_the_interval(clock, tmp_path) -> None:
    """The brightness of a chain's image has such noise. With seeds as the samples, the error is
    known to a factor of a few; with the 768 pixels as the samples, it would seem to be known to 15
    %."""
    integrators = {
        "alone": noisy_integrator(clock), "shared": noisy_integrator(clock, is_shared=True)
    }
    scene = compare_noisy(compare.sweep([16]), integrators, tmp_path, seeds=8)
    factors = []
    for record in scene["integrators"]:
        error = record["levels"][-1]["figures"]["relmse"]
        factors.append(error["high"] / error["low"])
    assert factors[0] < 1.15
    assert factors[1] > 3


#: Few chains, which move little.
_CHAINS = {
    "pssmlt": {"type": "pssmlt", "bidirectional": False, "chains": 64, "p_large": 0.02},
    "erpt": {"type": "erpt", "outliers": 0.0, "chain_length": 100},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", _CHAINS)
def test_the_variance_of_chains_is_the_variance_between_seeds(name: str) -> None:
    """What is told equals what many renders show. As many independent samples would have a fraction
    of it, and a chain's own samples, taken for such, would say so."""
    common = {"max_depth": 3, "direct_samples": -1, "luminance_samples": 4096}
    scene = mi.load_dict(stage())
    chains: dict[str, Any] = {**common, **_CHAINS[name]}
    told = [
        np.array(mi.render(scene, integrator=with_variance(chains, 16), spp=64, seed=seed))
        for seed in (1, 2)
    ]
    told = np.mean([image[..., 3:].mean() for image in told])
    images = batches(scene, mi.load_dict(chains), 4, range(100, 148))
    shown = images.var(axis=0, ddof=1).mean() / 16
    assert told == pytest.approx(shown, rel=0.25)
    independent = {**common, "type": "pssmlt", "bidirectional": False, "p_large": 1.0}
    images = batches(scene, mi.load_dict(independent), 4, range(100, 116))
    assert images.var(axis=0, ddof=1).mean() / 16 < 0.5 * told
