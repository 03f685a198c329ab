"""The heuristics of multiple importance sampling, and their words in a scene."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.mis.parameters import HEURISTICS
from mitsuba_ext.transport.mis import (
    cutoff_heuristic_of,
    maximum_heuristic,
    power_heuristic,
    power_heuristic_of,
)
from tests.support.statistical import batches, load

pytestmark = pytest.mark.usefixtures("variant")

#: Densities from zero to the densities of near mirrors.
_DENSITIES = np.concatenate([[0.0], np.geomspace(1e-12, 1e12, 25), [0.1, 0.3]])

_MAKERS = {
    "power": lambda: power_heuristic, "power 2": lambda: power_heuristic_of(2),
    "power 1": lambda: power_heuristic_of(1), "power 5.5": lambda: power_heuristic_of(5.5),
    "cutoff": lambda: cutoff_heuristic_of(0.1), "cutoff 0": lambda: cutoff_heuristic_of(0),
    "cutoff 1": lambda: cutoff_heuristic_of(1), "maximum": lambda: maximum_heuristic,
}  # fmt: skip


def _pairs() -> tuple[mi.Float, mi.Float]:
    a, b = np.meshgrid(_DENSITIES, _DENSITIES)
    some = (a > 0) | (b > 0)
    return mi.Float(a[some].astype(np.float32)), mi.Float(b[some].astype(np.float32))


@pytest.mark.parametrize("name", _MAKERS)
def test_the_weights_of_two_techniques_add_up_to_one(name: str) -> None:
    heuristic, (a, b) = _MAKERS[name](), _pairs()
    weight, other = heuristic(a, b).numpy(), heuristic(b, a).numpy()
    assert np.isfinite(weight).all() and weight.min() >= 0
    np.testing.assert_allclose(weight + other, 1, rtol=1e-6)
    # What cannot have drawn the sample has no weight
    assert (weight[a.numpy() == 0] == 0).all()


@pytest.mark.parametrize("name", _MAKERS)
def test_without_any_density_there_is_no_weight(name: str) -> None:
    heuristic = _MAKERS[name]()
    assert heuristic(mi.Float(0), mi.Float(0)).numpy()[0] == 0


def test_heuristics_have_the_weights_of_their_formulas() -> None:
    a, b = mi.Float(3), mi.Float(1)
    assert power_heuristic_of(1)(a, b)[0] == pytest.approx(3 / 4)
    assert power_heuristic_of(2)(a, b)[0] == pytest.approx(9 / 10)
    assert power_heuristic_of(3)(a, b)[0] == pytest.approx(27 / 28)
    # 1 ≥ 0.2 · 3: both count; 1 < 0.5 · 3: only the larger one
    assert cutoff_heuristic_of(0.2)(a, b)[0] == pytest.approx(3 / 4)
    assert cutoff_heuristic_of(0.5)(a, b)[0] == 1 and cutoff_heuristic_of(0.5)(b, a)[0] == 0
    assert maximum_heuristic(a, b)[0] == 1 and maximum_heuristic(b, a)[0] == 0
    assert maximum_heuristic(a, a)[0] == 0.5


def _images(**slots: Any) -> np.ndarray:
    scene = load("cornell_box", width=8, height=8, rfilter="box")
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3, **slots})
    return batches(scene, integrator, 16, [1])


@pytest.mark.parametrize("heuristic", ["cutoff", "light"])
def test_a_word_is_the_nested_plugin_with_its_defaults(heuristic: str) -> None:
    nested = {"type": "mis_heuristic", "heuristic": heuristic}
    np.testing.assert_allclose(_images(mis=heuristic), _images(mis=nested), rtol=1e-5)


def test_only_the_power_heuristic_gives_the_image_of_path() -> None:
    images = {word: _images(mis=word) for word in HEURISTICS}
    np.testing.assert_allclose(_images(), images["power"], rtol=1e-5)
    for word in HEURISTICS[1:]:
        assert abs(images[word] - images["power"]).max() > 1e-3 * images["power"].mean(), word


def test_bsdf_samples_alone_trace_no_shadow_rays() -> None:
    scene = load("cornell_box", width=8, height=8, rfilter="box")
    for word, traces in (("bsdf", False), ("light", True)):
        integrator = mi.load_dict({"type": "composed_path", "max_depth": 3, "mis": word})
        mi.render(scene, integrator=integrator, spp=4)
        dr.sync_thread()
        assert (integrator.statistics.rays["shadow"] > 0) == traces


@pytest.mark.parametrize("parameters, message", [
    ({"heuristic": "best"}, "one of power, balance, cutoff, maximum, bsdf, light"),
    ({"exponent": 0.5}, "at least"), ({"heuristic": "cutoff", "threshold": 2.0}, "at most"),
    ({"heuristic": "cutoff", "exponent": 3.0}, "nothing here uses"),
])  # fmt: skip
def test_wrong_parameters_are_refused(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises((RuntimeError, TypeError, ValueError), match=message):
        mi.load_dict({"type": "mis_heuristic", **parameters})
