"""When a long render ends: at an error (``render --until``), or after a time."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.images import metrics
from mitsuba_ext.images.metrics import RELATIVE_FLOOR
from mitsuba_ext.long_renders import long_render
from mitsuba_ext.long_renders.announced_error import announced_error
from mitsuba_ext.long_renders.batch_renderer import BatchRenderer
from mitsuba_ext.long_renders.intervals import Interval
from mitsuba_ext.long_renders.long_render import Goal, LongRender
from mitsuba_ext.long_renders.state import RenderState
from tests.support.clock import Clock
from tests.support.long_renders import LEARNER

pytestmark = pytest.mark.usefixtures("batches_of_sixteen_samples")

# ---- The error that batches announce ----

_BATCHES, _SPP, _SIDE = 8, 16, 64


def _announced_and_true(chance: float, rng: np.random.Generator) -> tuple[float, float]:
    """For an image of twos: half of a pixel comes from all samples, half from rare ones."""
    shape = (_BATCHES, _SIDE, _SIDE, 1)
    batches = 1 + rng.binomial(_SPP, chance, shape) / (_SPP * chance) * np.ones(3)
    mean, variance = batches.mean(0), batches.var(0, ddof=1) / _BATCHES
    true = ((mean - 2) ** 2).mean() / (4 * (1 + RELATIVE_FLOOR))
    return announced_error(mean, variance), true


@pytest.mark.parametrize(("chance", "most"), [(0.5, 1.1), (1 / 64, 1.3), (1 / 1024, 4.1)])
def test_bright_spots_do_not_hide_their_error(chance, most):
    """In the last case, an eighth of the pixels has one. The announced error is never too small. It
    is at most 4 times too large, because the median lacks half of the light."""
    rng = np.random.default_rng(1)
    announced, true = np.mean([_announced_and_true(chance, rng) for _ in range(10)], axis=0)
    assert 0.95 < announced / true < most


def test_pixels_that_are_not_finite_do_not_count():
    rng = np.random.default_rng(2)
    mean, variance = rng.uniform(1, 2, (2, 16, 16, 3))
    whole = announced_error(mean, variance)
    mean[3, 4, 1], variance[9, 9, 0], mean[12, 2] = np.nan, np.inf, np.inf
    assert announced_error(mean, variance) == pytest.approx(whole, rel=0.05)
    assert announced_error(mean * np.nan, variance) is None
    assert announced_error(np.zeros((4, 4, 3)), np.zeros((4, 4, 3))) is None


def test_the_error_of_one_pixel_is_announced():
    mean, variance = np.full((1, 1, 3), 2.0), np.full((1, 1, 3), 0.04)
    assert announced_error(mean, variance) == pytest.approx(0.01 / (1 + RELATIVE_FLOOR))


# ---- Renders that end ----


def test_a_render_ends_when_the_error_is_small_enough(request_of):
    """The announced error is the error of the image."""
    request = request_of("path")
    render = LongRender(BatchRenderer(request), RenderState())
    assert render.run(Goal(error=4e-3))
    assert 8 * 16 <= render.state.spp < 1 << 12 and render.error <= 4e-3
    # In one batch, as the error of an image does not depend on the number of its batches
    scene, path = mi.load_file(request.scene), mi.load_dict({"type": "path"})
    truth, *others = (
        np.array(mi.render(scene, integrator=path, spp=spp, seed=seed))[..., :3]
        for seed, spp in enumerate([1 << 13] + 64 * [render.state.spp], start=9)
    )
    squares = [metrics.relative_mse(other, truth) for other in others]
    assert 0.7 < np.mean(squares) / render.error < 1.4
    assert not render.run(Goal(error=1e-9), is_stopped=lambda: True)
    assert render.run(Goal(spp=render.state.spp, error=1e-9))


def test_a_black_image_has_no_error_to_reach(run, make_scene, tmp_path):
    scene = make_scene()
    scene.write_text(re.sub("<emitter.*?/>", "", scene.read_text()))
    command = ("render", scene, "-o", tmp_path / "a.exr", "--until", "0.01")
    code, _, err = run(*command)
    assert code == 2 and "is black, or not finite, after 128 samples per pixel" in err
    assert run(*command, "--spp", 256)[0] == 0
    assert run(*command, "--spp", 1 << 20, "--time", 0.2)[0] == 0


@pytest.fixture
def paced(monkeypatch):
    """A clock that only batches move: the first batch compiles, and batches after the fifth are
    slow."""
    clock, batch = Clock(), BatchRenderer.render
    monkeypatch.setattr(long_render, "time", clock)

    def timed(self, which, learned):
        clock.now += 5 * (which.index == 0) + which.spp * (0.1 if which.index < 5 else 0.3)
        return batch(self, which, learned)

    monkeypatch.setattr(BatchRenderer, "render", timed)
    return clock


def test_the_first_batches_tell_how_many_fit_into_the_time(request_of, paced):
    render = LongRender(BatchRenderer(request_of("path")), RenderState())
    assert render.run(Goal(seconds=15))
    assert render.state.spp == 100


@pytest.mark.parametrize(("seconds", "spp"), [(5.5, 5), (6.2, 12), (8.0, 30)])
def test_a_time_in_which_few_batches_fit_is_kept(request_of, paced, seconds, spp):
    """A batch of the usual length has 16 samples per pixel."""
    render = LongRender(BatchRenderer(request_of("path")), RenderState())
    assert render.run(Goal(seconds=seconds))
    assert render.state.spp == spp and paced.now <= 1.05 * seconds


def test_a_batch_learns_for_others_only_where_there_is_time_for_them(request_of, paced):
    for seconds, learns in ((8.0, False), (40.0, True)):
        state = RenderState()
        LongRender(BatchRenderer(request_of(LEARNER)), state).run(Goal(seconds=seconds))
        assert (state.learned is not None) == learns


def test_intervals_are_times_or_numbers_of_samples():
    assert Interval.parse("1.5m") == Interval(seconds=90) and Interval.parse("2h").seconds == 7200
    assert Interval.parse("100spp") == Interval(spp=100)
    for text in ("", "0s", "5", "1.5spp", "-3s", "s"):
        with pytest.raises(ValueError, match="expected something like"):
            Interval.parse(text)
