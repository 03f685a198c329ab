"""``auto`` begins as ``path`` and tries light paths between pilots; ``auto_path`` tries maps."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice import light_paths
from mitsuba_ext.planning import planner, verdicts
from tests.support.emitters_and_materials import EMITTERS, below_the_lamp
from tests.support.fogs import fog
from tests.support.light_choices import mixed_lights
from tests.support.stage import stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    SEEDS,
    assert_same_image,
    assert_same_quarters,
    batches,
    load,
)

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(autouse=True)
def small_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(light_paths, "_SPARSE", 1 << 12)


def auto(**parameters: Any) -> mi.Integrator:
    return mi.load_dict({"type": "auto", "max_depth": 6, **parameters})


def learned(scene: mi.Scene | dict, spp: int, integrator: mi.Integrator | None = None) -> str:
    scene = mi.load_dict(scene) if isinstance(scene, dict) else scene
    integrator = integrator or auto()
    integrator.render(scene, spp=spp, seed=1)
    return integrator.statistics.learned


def test_a_render_that_is_too_short_to_learn_says_so() -> None:
    short = "nothing: there are fewer than 262144 samples"
    for name in ("auto", "auto_path"):
        integrator = mi.load_dict({"type": name, "max_depth": 2})
        assert learned(stage(), 32, integrator) == short
        assert "learns_from = 262144 samples" in str(integrator)
    asked = mi.load_dict({"type": "auto_path", "max_depth": 2, "pilot_spp": 8})
    assert learned(stage(), 32, asked) != short and "learns_from" not in str(asked)


def test_a_render_that_is_too_short_to_learn_has_a_light_tree() -> None:
    scene = mi.load_dict(mixed_lights())
    tree = {"type": "composed_path", "max_depth": 6, "next_event": "tree"}
    others = ({"type": name, "max_depth": 6} for name in ("auto", "auto_path", "neepp"))
    expected, *images = (
        np.array(mi.load_dict(made).render(scene, spp=1, seed=1)) for made in (tree, *others)
    )
    for image in images:
        np.testing.assert_array_equal(image, expected)


@pytest.fixture
def trials(monkeypatch: pytest.MonkeyPatch) -> list[light_paths.LightPathTrial]:
    """The trials that renders make."""
    found: list[light_paths.LightPathTrial] = []
    made = light_paths.LightPathTrial.__init__

    def remembered(trial: light_paths.LightPathTrial, *arguments: Any, **options: Any) -> None:
        made(trial, *arguments, **options)
        found.append(trial)

    monkeypatch.setattr(light_paths.LightPathTrial, "__init__", remembered)
    return found


def test_light_paths_that_merge_take_the_place_of_guides_where_they_pay(
    monkeypatch: pytest.MonkeyPatch, trials: list[light_paths.LightPathTrial]
) -> None:
    monkeypatch.setattr(light_paths, "_LEAST_SPARSE", 1 << 11)
    integrator = auto()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        text = learned(load("caustic", width=96, height=54), 64, integrator)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    small, large = (len(trial.samples) for trial in trials)
    assert small < 3000 < large
    kernels = [k for k in kernels if k["operation_count"] > 1000]
    of_small, of_large = ({k["hash"] for k in kernels if k["size"] == n} for n in (small, large))
    assert of_small == of_large != set(), "trials of all sizes share their kernels"
    assert "light paths pay: " in text and "guide: " not in text
    effects = integrator.statistics.effects
    assert "directions" not in effects and "next_event" not in effects
    effect = effects["light_paths"]
    assert effect["is_kept"] and effect["light_paths"] > 0
    assert f"({effect['variance']:.2f} of the variance" in text
    assert f"{effect['time']:.1f} x the time" in text


def test_guides_that_paid_are_learned_again_beside_light_paths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(planner, "LIGHT_PATH_KERNELS", 0.0)
    integrator = auto()
    scene = load("corridor", width=96, height=54)
    text = learned(scene, 64, integrator)
    assert "guide: " in text and "light paths pay: " in text
    assert integrator.statistics.effects["directions"]["is_kept"]
    assert "roulette" not in integrator.learners


def test_a_coarse_film_predicts_as_the_whole_film(
    monkeypatch: pytest.MonkeyPatch, trials: list[light_paths.LightPathTrial]
) -> None:
    scene, estimates = load("cornell_box", width=64, height=36), []
    monkeypatch.setattr(light_paths, "_MOST", 1.0)
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    for samples in (1 << 10, 1 << 14):
        for size in ("_SPARSE", "_LEAST_SPARSE"):
            monkeypatch.setattr(light_paths, size, samples)
        auto().render(scene, spp=32, seed=1)
        estimates.append((trials[-1].estimate.mean.mean(), trials[-1].predicted.variances[:8]))
    (coarse, few), (whole, many) = estimates
    assert len(trials[0].samples) < 64 * 36 < len(trials[1].samples)
    assert coarse == pytest.approx(whole, rel=0.1)
    np.testing.assert_allclose(few, many, rtol=0.35)


def test_light_paths_are_left_out_under_an_open_sky_after_a_small_trial(
    monkeypatch: pytest.MonkeyPatch, trials: list[light_paths.LightPathTrial]
) -> None:
    monkeypatch.setattr(light_paths, "_LEAST_SPARSE", 1 << 11)
    scene = stage(light=EMITTERS["constant"](), camera=below_the_lamp())
    assert "light paths do not pay" in learned(scene, 1200)
    assert [len(trial.samples) < 3000 for trial in trials] == [True]


@pytest.mark.slow
@pytest.mark.parametrize("light", ["rectangle", "constant"])
def test_the_choice_does_not_change_the_mean(light: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[light](), camera=below_the_lamp()), optimize=False)
    integrator = auto(max_depth=4)
    images = batches(scene, integrator, 1200, SEEDS[:MANY_SEEDS])
    assert "light paths" in integrator.statistics.learned
    path = mi.load_dict({"type": "path", "max_depth": 4})
    expected = batches(scene, path, 1200, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.005)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["moving glass and a lens", "spectral"])
def test_light_paths_take_the_place_of_maps_and_keep_the_mean(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Although the render is short
    monkeypatch.setattr(planner, "LIGHT_PATH_KERNELS", 0)
    ball = {"type": "sphere", "center": [-0.3, 0, 0.5], "radius": 0.4,
            "bsdf": {"type": "dielectric"}}  # fmt: skip
    camera = below_the_lamp()
    if case == "spectral":
        mi.set_variant("llvm_ad_spectral")
    else:
        ball = {"type": "moving", "translate": [0.6, 0, 0], "in": ball}
        camera = below_the_lamp("thinlens", aperture_radius=0.1, focus_distance=4.0,
                                shutter_open=0.0, shutter_close=1.0)  # fmt: skip
    scene = mi.load_dict(stage(camera=camera, ball=ball), optimize=False)
    integrator = auto(max_depth=5)
    images = batches(scene, integrator, 1024, SEEDS[:MANY_SEEDS])
    text = integrator.statistics.learned
    assert "light paths pay: 1 for each camera path" in text and "merging" not in text
    assert not any(word in text for word in ("times:", "lens:", "wavelengths:"))
    path = mi.load_dict({"type": "composed_path", "max_depth": 5})
    expected = batches(scene, path, 4096, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, 0.03)


def test_short_renders_learn_nothing() -> None:
    scene = load("cornell_box", width=32, height=18)
    images = [
        batches(scene, mi.load_dict({"type": name, "max_depth": 4}), 32, [3])[0]
        for name in ("auto", "composed_path")
    ]
    assert_same_image(*images)


def test_auto_equals_auto_path_where_light_paths_cannot_be_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(verdicts, "least_samples", lambda is_gpu: 0)
    scene = mi.load_dict(fog("area"))
    images = []
    for name in ("auto", "auto_path"):
        integrator = mi.load_dict({"type": name, "max_depth": 4})
        images.append(np.array(integrator.render(scene, spp=64, seed=2)))
        assert "light paths" not in integrator.statistics.learned
    assert_same_image(*images)


def test_a_restored_choice_needs_no_pilot(tmp_path) -> None:
    file = str(tmp_path / "learned.npz")
    scene = load("caustic", width=96, height=54)
    text = learned(scene, 64, auto(save_learned=file))
    again = learned(scene, 4, auto(load_learned=file))
    assert "light paths pay: " in again
    choice = text.rpartition("light paths")[2].partition(" (")[0]
    assert again.endswith(f"light paths{choice}")


@pytest.mark.slow
def test_equal_seeds_give_equal_images() -> None:
    scene = load("caustic", width=96, height=54)
    images = [np.array(auto().render(scene, spp=64, seed=4)) for _ in range(2)]
    np.testing.assert_allclose(*images, rtol=1e-3, atol=1e-4)


def test_integrators_that_distribute_samples_refuse_it() -> None:
    with pytest.raises(RuntimeError, match='use "auto_path"'):
        mi.load_dict({"type": "adaptive", "nested": {"type": "auto"}})


def test_samples_before_light_paths_are_left_out_where_these_have_far_less_variance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = load("caustic", width=96, height=54)
    weights, images = [], []
    for least in (0.4, 0.0):
        monkeypatch.setattr(verdicts, "FAR_LESS", least)
        images.append(np.array(auto().render(scene, spp=64, seed=4)))
        weights.append(np.array(scene.sensors()[0].film().develop(raw=True))[..., -1].mean())
    # These samples weigh about half as much as others
    assert weights[0] < 0.97 * weights[1]
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=0.05)


# ---- ``auto_path``: maps of the numbers of camera rays ----


def test_auto_path_uses_maps_of_times_where_they_pay() -> None:
    scene = load("six_balls", width=96, height=54)
    plain = mi.load_dict({"type": "composed_path", "max_depth": 2})
    noise = batches(scene, plain, 64, [1, 2]).var(axis=0).mean()
    integrator = mi.load_dict({"type": "auto_path", "max_depth": 2, "pilot_spp": 32})
    ours = batches(scene, integrator, 64, [1, 2]).var(axis=0).mean()
    assert "times" in integrator.statistics.learned
    assert ours < 0.4 * noise  # a tenth


@pytest.mark.slow
def test_where_no_ray_has_a_time_or_a_lens_point_auto_path_renders_the_same_image() -> None:
    """The weights of stages do not change either."""
    scene = load("cornell_box", width=32, height=18)
    words = {"directions": "guided", "next_event": "contribution"}
    images = [
        batches(scene, mi.load_dict({**plugin, "max_depth": 4}), 32, [3])[0]
        for plugin in (
            {"type": "auto_path", "pilot_spp": 32}, {"type": "composed_path", **words}
        )  # fmt: skip
    ]
    assert_same_image(*images)
