"""``pssmlt`` renders what ``path`` renders: depths, interruption, statistics, errors."""

from __future__ import annotations

import os
import re
import signal
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.chains.looped import LoopedChains
from mitsuba_ext.estimators.chains.visits import MetropolisRender
from tests.support.chain_integrators import ALONE, pssmlt
from tests.support.clock import PassClock
from tests.support.stage import stage
from tests.support.statistical import (
    MANY_SEEDS,
    REFERENCE_SEEDS,
    assert_images_are_sound,
    assert_same_image,
    assert_same_quarters,
    batches,
    one_thread,
    some,
)
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")

#: Samples from which chains start, by default: a square.
_BOOTSTRAP = 317**2


def _assert_same_seed(image: np.ndarray, other: np.ndarray) -> None:
    """Visits are added in the order in which threads come to them."""
    np.testing.assert_allclose(image, other, rtol=1e-4, atol=1e-5 * other.mean())


# ---- What it renders ----


_SHORT = {
    "few chains": {"chains": 100},
    "chains of one mutation": {},
    "no uniform samples": {"kelemen_style_weights": False, "p_large": 0.05},
}


@pytest.mark.parametrize("which", some("few chains", of=_SHORT))
def test_short_renders_are_right_on_average(which: str) -> None:
    """One mutation per pixel is enough: chains have the right distribution from the beginning."""
    parameters = {**ALONE, **_SHORT[which]}
    scene = mi.load_dict(stage(), optimize=False)
    images = batches(scene, pssmlt(**parameters), 1, range(1, 33))
    expected = batches(scene, REFERENCE.make(4), 1024, REFERENCE_SEEDS[:MANY_SEEDS])
    assert_same_quarters(images, expected, precision=0.01)


@pytest.mark.parametrize("max_depth", [0, 1, 2])
def test_camera_samples_alone_find_short_paths(max_depth: int) -> None:
    """The image agrees with ``path``; chains have nothing to find."""
    scene, integrator = mi.load_dict(stage()), pssmlt(max_depth)
    image, path = (batches(scene, i, 16, [5])[0] for i in (integrator, REFERENCE.make(max_depth)))
    assert path.any() == (max_depth > 0)
    assert_same_image(image, path) if path.any() else assert_images_are_sound(image)
    assert image.any() == path.any()
    assert "nothing for chains to find: the image is 16 camera samples" in (
        integrator.statistics.learned
    )


@pytest.mark.parametrize("direct", [-1, 16])
def test_statistics_say_that_chains_found_no_light(direct: int) -> None:
    integrator = pssmlt(direct_samples=direct)
    integrator.render(mi.load_dict(stage(light={})), spp=16)
    assert "the image is 16 camera samples per pixel" in integrator.statistics.learned
    assert not integrator.statistics.interrupted


def test_all_mutations_are_made_if_chains_do_not_divide_them() -> None:
    """Some more than asked for, so that all chains make as many."""
    integrator = pssmlt(**ALONE, chains=100)
    batches(mi.load_dict(stage()), integrator, 1, [1])
    camera, statistics = 16 * 256, integrator.statistics
    assert statistics.rays["camera"] == camera + _BOOTSTRAP + 300 and statistics.spp == 1


# ---- Seeds, interruption, time budget ----


@pytest.fixture
def small_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen mutations per pixel: four of each chain."""
    monkeypatch.setattr(LoopedChains, "launch", 4)


#: 64 mutations per pixel are then 16 of each chain.
_FOUR_PER_PIXEL = {"chains": 1024}


def test_a_seed_gives_one_image() -> None:
    """Bit for bit, if one thread adds visits. Other seeds give others."""
    scene = mi.load_dict(stage())
    with one_thread():
        first, again, other = (
            pssmlt(**_FOUR_PER_PIXEL).render(scene, seed=seed, spp=16).numpy()
            for seed in (7, mi.UInt32(7), 8)
        )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).mean() > 0.01 * first.mean()


@pytest.mark.usefixtures("small_launches")
def test_launches_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = mi.load_dict(stage())
    (in_four,) = batches(scene, pssmlt(**_FOUR_PER_PIXEL), 64, [3])
    monkeypatch.setattr(LoopedChains, "launch", 16)
    (in_one,) = batches(scene, pssmlt(**_FOUR_PER_PIXEL), 64, [3])
    _assert_same_seed(in_four, in_one)


@pytest.mark.usefixtures("small_launches")
def test_cancelling_returns_the_image_so_far() -> None:
    scene, integrator = mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL)
    (half,) = batches(scene, integrator, 32, [5])
    integrator.progress = lambda fraction: integrator.cancel() if fraction >= 0.5 else None
    (image,) = batches(scene, integrator, 64, [5])
    assert integrator.statistics.interrupted and integrator.statistics.spp == 32
    _assert_same_seed(image, half)
    integrator.progress = None
    batches(scene, integrator, 64, [5])
    assert integrator.statistics.spp == 64 and not integrator.statistics.interrupted


@pytest.mark.usefixtures("small_launches")
def test_ctrl_c_leaves_the_image_so_far_in_the_film() -> None:
    scene, integrator = mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL)
    (quarter,) = batches(scene, integrator, 16, [5])
    integrator.progress = lambda fraction: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(scene, seed=5, spp=64)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 16
    _assert_same_seed(np.array(scene.sensors()[0].film().bitmap()), quarter)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("small_launches")
def test_ctrl_c_in_the_last_launch_comes_too_late() -> None:
    integrator = pssmlt(**_FOUR_PER_PIXEL)
    integrator.progress = lambda fraction: fraction < 1 or os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        integrator.render(mi.load_dict(stage()), spp=64)
    assert integrator.statistics.spp == 64 and not integrator.statistics.interrupted


@pytest.mark.usefixtures("small_launches")
def test_an_error_in_the_progress_callback_leaves_the_image_so_far() -> None:
    scene, integrator = mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL)
    (quarter,) = batches(scene, integrator, 16, [5])

    def fail(fraction: float) -> None:
        raise OSError("no terminal")

    integrator.progress = fail
    with pytest.raises(OSError, match="no terminal"):
        integrator.render(scene, seed=5, spp=64)
    _assert_same_seed(np.array(scene.sensors()[0].film().bitmap()), quarter)


def test_the_timeout_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock counts mutations. The image has the mutations that fit into the time."""
    scene = mi.load_dict(stage())
    (whole,) = batches(scene, pssmlt(chains=256), 512, [5])
    clock, advance = PassClock(monkeypatch), LoopedChains.advance

    def advance_on_clock(chains: LoopedChains, steps: int) -> Any:
        clock.now += 0.05 * steps
        return advance(chains, steps)

    monkeypatch.setattr(LoopedChains, "advance", advance_on_clock)
    integrator = pssmlt(chains=256, timeout=10.0)
    image = integrator.render(scene, seed=5, spp=512).numpy()
    assert 10 * 0.9 <= clock.now <= 10 * 1.1, "camera samples included"
    assert 100 < integrator.statistics.spp < 200 and not integrator.statistics.interrupted
    assert image.mean() == pytest.approx(whole.mean(), rel=0.05)


def test_another_seed_and_more_mutations_compile_nothing() -> None:
    scene, integrator = mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL)
    batches(scene, integrator, 64, [1, 2])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        batches(scene, integrator, 256, [3])
        kernels = dr.kernel_history([dr.KernelType.JIT])
    compiled = [k for k in kernels if not k["cache_hit"] and k["operation_count"] > 100]
    assert not compiled, [k["operation_count"] for k in compiled]


def test_statistics_count_rays_and_acceptance() -> None:
    integrator = pssmlt(**_FOUR_PER_PIXEL, p_large=0.5)
    batches(mi.load_dict(stage()), integrator, 64, [1])
    statistics = integrator.statistics
    assert statistics.rays["camera"] == (16 + 64) * 256 + _BOOTSTRAP and statistics.spp == 64
    assert statistics.rays["scatter"] > 0.5 * (16 + 64) * 256
    assert 0 < statistics.rays["shadow"] <= statistics.connections
    accepted = [float(x) for x in re.findall(r"([\d.]+)% of", statistics.learned)]
    assert len(accepted) == 2 and 0 < accepted[0] < accepted[1] < 100
    *_, brightness, stay = statistics.learned.split("; ")
    assert re.fullmatch(r"brightness known to 0\.\d%", brightness)
    assert re.fullmatch(r"a chain stayed at one path for \d+ of \d+ mutations", stay)


def test_uncertain_brightness_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """The criterion is the standard error of the samples from which chains started."""
    said: list[str] = []
    monkeypatch.setattr(mi, "Log", lambda level, text: level < mi.LogLevel.Warn or
                        said.append(text))  # fmt: skip
    scene = mi.load_dict(stage())
    for samples in (16, 100_000):
        integrator = pssmlt(**ALONE, chains=16, luminance_samples=samples)
        batches(scene, integrator, 1, [1])
        assert len(said) == 1 and '"luminance_samples"' in said[0], said


def test_a_chain_that_stays_gives_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stay is measured by the visits, relative to the visits of a pixel."""
    told: list[str] = []
    monkeypatch.setattr(mi, "Log", lambda level, text: told.append(text))
    monkeypatch.setattr(MetropolisRender, "long_stay", 1)
    monkeypatch.setattr(MetropolisRender, "long_stay_fraction", 0.01)
    batches(mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL, p_large=0.5), 64, [1])
    assert any("stayed at one path" in text for text in told)
    told.clear()
    monkeypatch.setattr(MetropolisRender, "long_stay_fraction", 1e6)
    batches(mi.load_dict(stage()), pssmlt(**_FOUR_PER_PIXEL, p_large=0.5), 64, [1])
    assert not any("stayed at one path" in text for text in told)


# ---- Errors ----


@pytest.mark.parametrize(("parameters", "words"), [
    ({"direct_samples": -2}, "direct_samples.*-2"),
    ({"chains": -1}, "chains.*-1"),
    ({"p_large": 1.5}, r"p_large.*1\.5"),
    ({"luminance_samples": 0}, "luminance_samples.*0"),
    ({"next_event": "contribution"}, '"next_event".*pilots'),
    ({"pilot_spp": 3}, "has no parameter"),
])  # fmt: skip
def test_wrong_parameters_are_named(parameters: dict[str, Any], words: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=f'(?s)"pssmlt".*{words}|{words}'):
        pssmlt(**parameters)


@pytest.mark.parametrize("spp", [-1, 10**11])
def test_absurd_numbers_of_mutations_are_refused(spp: int) -> None:
    with pytest.raises(ValueError, match=f'"pssmlt".*{spp}'):
        pssmlt().render(mi.load_dict(stage()), spp=spp)


@pytest.mark.parametrize("outer", ["moment", "aov"])
def test_it_cannot_be_nested_where_single_samples_are_asked_for(outer: str) -> None:
    more = {"aovs": "depth:depth"} if outer == "aov" else {}
    nesting = mi.load_dict({"type": outer, "image": {"type": "pssmlt", "max_depth": 2}, **more})
    with pytest.raises((NotImplementedError, RuntimeError), match='"pssmlt": chains'):
        nesting.render(mi.load_dict(stage()), spp=1)


def test_variance_can_nest_it() -> None:
    scene = mi.load_dict(stage())
    nested = {"type": "pssmlt", "bidirectional": False, "max_depth": 4, **_FOUR_PER_PIXEL}
    integrator = mi.load_dict({"type": "variance", "nested": nested, "batches": 4})
    image = integrator.render(scene, spp=64).numpy()
    assert image.shape[-1] > 3 and np.isfinite(image).all() and image[..., 3:].min() >= 0
