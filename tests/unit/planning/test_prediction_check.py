"""``auto`` measures the passes with light paths, and goes back where they do not pay."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.choice import light_paths
from mitsuba_ext.estimators.light_paths.choice.candidates import Candidate
from mitsuba_ext.estimators.light_paths.choice.light_paths import LightPathChoice, LightPathTrial
from mitsuba_ext.estimators.light_paths.choice.predicted_errors import PredictedErrors
from mitsuba_ext.estimators.light_paths.path_tracer import BidirectionalPathTracer
from mitsuba_ext.images.coarse_film import CoarseFilm
from mitsuba_ext.planning.planner import LearningPlan, Planner
from mitsuba_ext.planning.prediction_check import PredictionCheck
from mitsuba_ext.planning.technique import ParameterReader, Setting
from mitsuba_ext.planning.trial import Rival
from mitsuba_ext.rendering.pass_images import FEWEST_PASSES, PassImages
from mitsuba_ext.rendering.stages import Stage
from mitsuba_ext.techniques.guided_directions.learner import GuideLearner
from mitsuba_ext.techniques.guided_directions.parameters import Guided
from mitsuba_ext.techniques.learned_lights.learner import LightMapLearner
from mitsuba_ext.transport.decisions import Decisions
from mitsuba_ext.transport.walk import Walk
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

_SIZE, _SPP = 48, 16


def film_of(rfilter: str, **parameters: Any) -> mi.Film:
    size = {"width": _SIZE, "height": _SIZE}
    return mi.load_dict({"type": "hdrfilm", "rfilter": {"type": rfilter}, **size, **parameters})


def fill(images: PassImages, film: mi.Film, passes: int) -> None:
    """Adds camera samples of mean 1/2 and variance 1/12, and splats of mean 1 and variance 1 (one
    in two samples has a splat of 2 somewhere on the film), also beyond the edges of a film that
    samples its border."""
    film.prepare([])
    block, splats = film.create_block(), film.create_block()
    rng = np.random.default_rng(1)
    border = film.rfilter().border_size() if film.sample_border() else 0
    extent = _SIZE + 2 * border
    y, x = np.mgrid[:extent, :extent].reshape(2, -1).repeat(_SPP, axis=1) - border
    alpha = block.channel_count() - 4
    images.begin(block, splats, 0)
    for number in range(1, passes + 1):
        value = mi.Float(rng.random(x.size))
        position = mi.Point2f(x + rng.random(x.size), y + rng.random(x.size))
        block.put(position, [value, value, value, *[mi.Float(1)] * alpha, mi.Float(1)])
        value = mi.Float(2.0 * (rng.random(x.size) < 0.5))
        position = mi.Point2f(*(extent * rng.random((2, x.size)) - border))
        splats.put(position, [value, value, value, *[mi.Float(0)] * alpha, mi.Float(0)])
        images.add(block, splats, _SPP * number, 1.0)


@pytest.mark.parametrize("rfilter", ["box", "gaussian", "tent"])
@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_passes_show_mean_and_variance(rfilter: str, pixel_format: str) -> None:
    film = film_of(rfilter, pixel_format=pixel_format)
    images = PassImages(film)
    fill(images, film, 5)
    inner = np.s_[:, 3:-3, 3:-3]
    found = images.mean().numpy(), images.variance().numpy()
    mean, variance = np.reshape(found, (2, _SIZE, _SIZE))[inner].mean(axis=(1, 2))
    assert images.count == 5
    assert mean == pytest.approx(1.5, rel=0.01)
    # The splats of a pixel are Poisson distributed: half a splat of 2 for each sample
    expected = 1 / 12 + 0.5 * 2**2
    assert variance == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("efficiency", [0.8, 1.02, 1.25])
def test_a_choice_that_is_worse_than_predicted_is_seen(efficiency: float) -> None:
    film = film_of("gaussian", sample_border=True)
    border = 2 * film.rfilter().border_size()
    coarse = CoarseFilm.of(_SIZE + border, _SIZE + border, 512)
    of_path = np.full(coarse.width * coarse.height, 1 / 12 + 0.5 * 2**2)
    check = PredictionCheck(film, coarse, of_path)
    assert not check.failed(time=9.0, rival=9.0)
    fill(check.images, film, FEWEST_PASSES)
    # ``path`` has this variance
    failed = check.failed(time=2 / efficiency, rival=0.5)
    assert check.variance == pytest.approx(1, rel=0.05)
    assert failed == (efficiency < 0.9)


def test_lights_gain_little_where_rare_paths_make_the_variance() -> None:
    """The pilots hold none of these paths: they show the trial's variance of ``path`` only."""
    learner = LightMapLearner("contribution", 0, 1 << 20, 1 << 10, (_SIZE, _SIZE))
    learner.removed, learner._is_kept = 3.0, True
    learner.set_variance(variance=297.0, trimmed=1.0)
    effect = learner.effect.as_dict()
    assert (effect["variance"], effect["trimmed_variance"]) == (0.99, 0.25)


@pytest.mark.parametrize(("merges", "expected"), [(False, 4.0), (True, 8.0)])
def test_guides_help_light_paths_too_but_not_merging(merges: bool, expected: float) -> None:
    trial = LightPathTrial(film_of("box"), _SPP)
    trial.costs, trial._best = [1.0, 2.0], 1
    trial._choice = LightPathChoice(Candidate(0.25, merges=merges))
    seen = []
    trial.check = SimpleNamespace(failed=lambda *arguments: seen.append(arguments))
    assert trial.reconsider(Rival(8.0, guides=4.0)) is None
    assert seen == [(2.0, expected)]


@pytest.mark.parametrize("merges", [False, True])
def test_light_paths_that_can_be_guided_are_chosen_instead_of_guides(
    monkeypatch: pytest.MonkeyPatch, merges: bool
) -> None:
    """Twice the efficiency of ``path``, where guides have three times that."""
    predicted = SimpleNamespace(
        variances=np.array([1.0, 0.25]), uncertainty=np.zeros(2), of_path=np.ones(_SIZE**2),
        long_run=np.array([1.0, 0.25]),
    )  # fmt: skip
    monkeypatch.setattr(PredictedErrors, "of", lambda *_: predicted)
    monkeypatch.setattr(light_paths, "cost", lambda techniques, _: 1 + techniques.light_paths)
    trial = LightPathTrial(film_of("box"), _SPP)
    trial._moments = SimpleNamespace(
        samples=1 << 20, candidates=[Candidate(0.0), Candidate(1.0, merges=merges)], counts=None,
        estimate=lambda: None,
    )  # fmt: skip
    choice = trial.choose(Rival(3.0, guides=3.0))
    assert (choice is None) == merges
    # Whatever the pilots have made of guides
    assert trial.discards_pilots


def test_going_back_restores_the_guide_as_it_was() -> None:
    """It has neither the samples of later pilots nor the margin of the choice."""
    guide = GuideLearner.__new__(GuideLearner)
    guide.guide, guide.guidance = True, SimpleNamespace(efficiency=2.0)
    guide.finish = lambda: None
    competing = []

    def choose(rival: Rival) -> LightPathChoice:
        competing.append(rival.efficiency)
        return LightPathChoice(Candidate(1.0, merges=True))

    trial = SimpleNamespace(
        larger=lambda rival: None, choose=choose, check=None,
        leaves_out=lambda slot, finds_all_light: finds_all_light,
        can_be_guided=False, discards_pilots=True, path_variance=None,
        reconsider=lambda rival: competing.append(rival.efficiency), effect=None,
        __str__=lambda: "",
    )  # fmt: skip
    scene = load("caustic", width=96, height=54)
    setting = Setting(scene, scene.sensors()[0], 0, 6, 5, 1 << 18)
    techniques = {"directions": Guided(ParameterReader.of_defaults("auto"))}
    plan = LearningPlan((1, 1, 1), trial=lambda spp: trial, tries=True)
    planner = Planner(
        techniques, setting, (1, 1, 1, 1), lambda *_: None, Decisions(), plan
    )
    planner.learners["directions"], planner._next = guide, Stage(None)
    assert planner.next_stage().discards_earlier
    assert competing[0] > 2.5 and competing[1] == pytest.approx(2.0)


def test_auto_goes_back_to_its_earlier_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []

    def failed(check: PredictionCheck, time: float, rival: float) -> bool:
        counts.append(check.images.count)
        check.variance = 5.0
        return True

    stages, next_stage = [], Planner.next_stage

    def remembered(schedule: Planner) -> Any:
        stages.append(next_stage(schedule))
        return stages[-1]

    monkeypatch.setattr(PredictionCheck, "failed", failed)
    monkeypatch.setattr(Planner, "next_stage", remembered)
    integrator = mi.load_dict({"type": "auto", "max_depth": 6})
    scene = load("caustic", width=96, height=54)
    image = np.array(integrator.render(scene, spp=64, seed=1))
    assert np.isfinite(image).all()
    effect = integrator.statistics.effects["light_paths"]
    assert not effect["is_kept"] and effect["measured_variance"] == 5.0
    assert effect["variance"] == 5.0 and 0 < effect["predicted_variance"] < 1
    learned = integrator.statistics.learned
    assert "light paths do not pay" in learned and "guide" in learned
    assert counts and counts[0] >= FEWEST_PASSES
    kinds = [type(stage.estimator) for stage in stages if not stage.is_scout]
    assert kinds[-2:] == [BidirectionalPathTracer, Walk]
