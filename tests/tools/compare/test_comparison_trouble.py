"""Comparisons: references that do not fit, and failures."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from mitsuba_ext import compare
from mitsuba_ext.compare import InputError, experiment, progress
from mitsuba_ext.compare.experiment import run_seed
from mitsuba_ext.util import marks
from tests.support.noisy import WHITE, compare_noisy, noisy_integrator

import mitsuba as mi  # isort: skip

pytestmark = pytest.mark.usefixtures("variant", "without_report")


# ---- The reference ----


def test_reference_too_noisy_for_an_error_is_refused(clock, tmp_path):
    reference = tmp_path / "reference.exr"
    rng = np.random.default_rng(1)
    mean = 1 + 0.1 * rng.standard_normal((24, 32, 3))
    channels = [f"{name}.{color}" for name in ("mean", "variance") for color in "RGB"]
    pixels = np.concatenate([mean, np.full_like(mean, 0.01)], axis=2)
    compare.write_exr(reference, pixels, channels, {"spp": 100})
    comparison = compare.Comparison(
        compare.SceneSetup(WHITE, reference=reference),
        {"first": noisy_integrator(clock)},
        compare.sweep([4, 4000]),
        folder=tmp_path / "out",
    )
    scene = comparison.run()["scenes"][0]
    coarse, fine = scene["integrators"][0]["levels"]
    assert not coarse["refused"]
    assert coarse["figures"]["relmse"]["value"] == pytest.approx(1 / 4 / 1.01, rel=0.1)
    assert "too noisy: its own relMSE is 0.01" in fine["refused"]
    assert "--reference-spp" in fine["refused"]
    assert fine["figures"]["relmse"] is None and fine["figures"]["efficiency"] is None
    assert fine["ratios"]["efficiency"] is None


def test_reference_that_is_longer_than_needed_is_taken(clock, tmp_path):
    scene = compare.load_scene(WHITE, keep_integrator=False)
    long = compare.render_reference(scene, 64, tmp_path)
    assert compare.render_reference(scene, 16, tmp_path).path == long.path
    assert compare.render_reference(scene, 128, tmp_path).path != long.path
    assert compare.render_reference(scene, 200, tmp_path, enough=100).spp == 128


def test_an_interrupted_reference_continues_where_it_was(tmp_path):
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0, 0, 5])}
    sphere = compare.load_scene({**WHITE, "ball": ball}, keep_integrator=False)
    whole = compare.render_reference(sphere, 32, tmp_path)

    done = []

    def stop(fraction):
        done.append(fraction)
        if fraction == 0.5:
            raise KeyboardInterrupt

    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(KeyboardInterrupt):
        compare.render_reference(sphere, 32, other, progress=stop)
    resumed = compare.render_reference(sphere, 32, other, progress=done.append)
    assert len(done) == 16  # of 16 batches in all
    assert np.array_equal(resumed.mean, whole.mean)
    assert np.array_equal(resumed.variance, whole.variance)
    assert [path.suffix for path in other.iterdir()] == [".exr"]


def test_failing_reference_is_an_input_error_that_names_it(clock, tmp_path):
    def fail(props):
        class Fails(type(mi.load_dict({"type": "prb"}))):
            def render(self, *_, **__):
                raise ZeroDivisionError("no light")

        return Fails(props)

    mi.register_integrator("fails", fail)
    comparison = compare.Comparison(
        WHITE, ["path"], compare.equal_samples(4), folder=tmp_path, reference_integrator="fails"
    )
    with pytest.raises(InputError, match='the reference of "fails" failed: no light'):
        comparison.run()


def test_reference_of_another_scene_or_depth_is_warned_of(clock, tmp_path):
    reference = compare.render_reference(
        compare.load_scene(WHITE, keep_integrator=False), 16, tmp_path
    )
    deeper = {**WHITE, "integrator": {"type": "path", "max_depth": 5}}
    comparison = compare.Comparison(
        compare.SceneSetup(deeper, reference=reference.path),
        {"noisy": noisy_integrator(clock)},
        compare.equal_samples(4),
    )
    another, depth = comparison.run()["scenes"][0]["warnings"]
    assert "another scene" in another
    assert depth == "the reference has max_depth 3, the scene 5"


# ---- Trouble ----


def test_failing_integrator_is_a_row_with_its_earlier_runs(clock, tmp_path):
    integrators = {
        "first": noisy_integrator(clock),
        "fails": noisy_integrator(clock, sigma=2.0, fails_in=1),
    }
    scene = compare_noisy(compare.equal_samples(8), integrators, tmp_path)
    first, fails = scene["integrators"]
    assert (len(first["runs"]), len(fails["runs"])) == (3, 1)
    assert fails["error"] == "no light"
    assert "ZeroDivisionError" in fails["traceback"]
    assert not list(tmp_path.rglob("*.running"))
    assert "ZeroDivisionError" in compare.write_report(tmp_path).read_text()
    assert first["error"] == ""


def test_integrator_that_ends_the_process_politely_is_a_failed_row(clock, tmp_path):
    def leave(props):
        class Leaves(type(mi.load_dict({"type": "prb"}))):
            def render(self, *_, **__):
                raise SystemExit(5)

        return Leaves(props)

    mi.register_integrator("leaves", leave)
    integrators = {"first": noisy_integrator(clock), "leaves": "leaves"}
    first, leaves = compare_noisy(compare.equal_samples(8), integrators, tmp_path)["integrators"]
    assert len(first["runs"]) == 3 and leaves["error"] == "5"


def test_time_that_cannot_be_met_is_noted(clock, tmp_path):
    slow = {"slow": noisy_integrator(clock, cost=50.0)}
    record = compare_noisy(compare.equal_time(20), slow, tmp_path)["integrators"][0]
    assert record["runs"][0]["spp"] == 1
    assert "3 of 3 runs missed the time of 20 s" in record["notes"][0]


def test_fireflies_are_noted(clock, tmp_path):
    class Fireflies(type(mi.load_dict({"type": "prb"}))):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            clock.now += spp
            image = np.full((24, 32, 3), 1.1)
            image[3, 4] = 50
            return mi.TensorXf(image)

    mi.register_integrator("fireflies", Fireflies)
    scene = compare_noisy(compare.equal_samples(8), ["fireflies"], tmp_path)
    (note,) = scene["integrators"][0]["notes"]
    assert "0.1 % of the pixels make up 100% of relMSE" in note


def test_scene_that_fails_is_an_entry_and_does_not_stop_the_others(clock, tmp_path):
    broken = {**WHITE, "shape": {"type": "sphere", "radiu": 1.0}}
    comparison = compare.Comparison(
        [broken, WHITE], {"noisy": noisy_integrator(clock)}, compare.equal_samples(4),
        folder=tmp_path, reference_spp=16,
    )
    first, second = comparison.run()["scenes"]
    assert "radiu" in first["error"] and not second["error"]
    assert first["name"] != second["name"]
    assert "radiu" in compare.write_report(tmp_path).read_text()
    with pytest.raises(InputError, match="radiu"):
        compare.Comparison(broken, ["path"], compare.equal_samples(4)).run()


def test_a_second_comparison_continues_the_first(clock, tmp_path):
    calls = []
    integrators = {"noisy": noisy_integrator(clock, calls=calls)}

    def run(**options) -> dict:
        calls.clear()
        return compare_noisy(compare.equal_samples(8), integrators, tmp_path, **options)

    once = run(seeds=2)
    again = run(seeds=2)
    assert calls == []
    assert again["integrators"] == once["integrators"]
    more = run(seeds=3)
    assert [call for call in calls if call[1] == 8] == [(run_seed(0, 2), 8)]
    assert more["integrators"][0]["runs"][:2] == once["integrators"][0]["runs"]


def test_damaged_and_foreign_runs_are_rendered_again(clock, tmp_path):
    calls = []
    integrators = {"noisy": noisy_integrator(clock, calls=calls)}
    scene = compare_noisy(compare.equal_samples(8), integrators, tmp_path, seeds=1)
    path = tmp_path / scene["integrators"][0]["runs"][0]["image"]
    path.write_bytes(path.read_bytes()[:100])
    calls.clear()
    compare_noisy(compare.equal_samples(8), integrators, tmp_path, seeds=1)
    assert (run_seed(0, 0), 8) in calls
    calls.clear()
    others = {"noisy": noisy_integrator(clock, sigma=3.0, calls=calls)}
    compare_noisy(compare.equal_samples(8), others, tmp_path, seeds=1)
    assert (run_seed(0, 0), 8) in calls


def test_a_run_under_the_name_of_another_one_is_rendered_again(clock, tmp_path):
    calls = []
    integrators = {
        name: noisy_integrator(clock, sigma=sigma, calls=calls)
        for name, sigma in (("one", 1.0), ("two", 3.0))
    }

    def run() -> dict:
        return compare_noisy(compare.equal_samples(8), integrators, tmp_path, seeds=1)

    before = run()
    one, two = (tmp_path / each["runs"][0]["image"] for each in before["integrators"])
    two.write_bytes(one.read_bytes())
    calls.clear()
    again = run()
    assert (run_seed(0, 0), 8) in calls
    relmse = [[each["levels"][0]["figures"]["relmse"] for each in scene["integrators"]]
              for scene in (before, again)]  # fmt: skip
    assert relmse[0] == relmse[1]


def test_runs_of_a_live_object_are_not_taken_up(clock, tmp_path):
    calls = []
    integrator = mi.load_dict({"type": noisy_integrator(clock, calls=calls)})
    for _ in range(2):
        calls.clear()
        compare_noisy(compare.equal_samples(8), {"live": integrator}, tmp_path, seeds=1)
        assert (run_seed(0, 0), 8) in calls


@pytest.mark.slow
def test_times_are_compared_within_one_session(clock, tmp_path, monkeypatch):
    calls = []
    made = {
        name: noisy_integrator(clock, sigma=sigma, calls=calls)
        for name, sigma in (("first", 1.0), ("second", 0.5), ("third", 2.0))
    }

    def run_again(session: str, slowness: float, names: list[str]) -> dict:
        calls.clear()
        monkeypatch.setattr(marks, "SESSION", session)
        clock.slowness = slowness
        return compare_noisy(
            compare.equal_samples(64), {name: made[name] for name in names}, tmp_path
        )

    alone = run_again("monday", 1.0, ["first"])
    images = {path: path.read_bytes() for path in tmp_path.glob("scene/*.exr")}
    # A session on a machine of half the speed: the first integrator is timed again
    scene = run_again("tuesday", 2.0, ["first", "second"])
    assert len([call for call in calls if call[1] == 64]) == 6
    assert all(path.read_bytes() == content for path, content in images.items())
    first, second = (record["levels"][0] for record in scene["integrators"])
    assert first["figures"] == alone["integrators"][0]["levels"][0]["figures"]
    ratios = second["ratios"]
    assert list(ratios["seconds"].values()) == pytest.approx([1, 1, 1])
    assert ratios["efficiency"]["value"] == pytest.approx(4, rel=0.1)
    assert ratios["efficiency"]["low"] < ratios["efficiency"]["value"]
    assert first["ratios"]["efficiency"]["value"] == pytest.approx(1)
    (warning,) = scene["warnings"]
    assert "different sessions" in warning and "(timed again for that: first)" in warning
    # Nothing is missing: nothing is rendered
    assert run_again("wednesday", 3.0, ["first", "second"]) == scene and not calls
    # With another first integrator, the others are timed beside it
    scene = run_again("thursday", 4.0, ["third", "first", "second"])
    assert len([call for call in calls if call[1] == 64]) == 9
    for record in scene["integrators"]:
        assert record["levels"][0]["ratios"]["seconds"]["value"] == pytest.approx(1)


def test_times_without_a_common_session_give_no_ratio(clock, tmp_path, monkeypatch):
    integrators = {name: noisy_integrator(clock) for name in ("first", "second")}
    for session, name in (("monday", "first"), ("tuesday", "second")):
        monkeypatch.setattr(marks, "SESSION", session)
        compare_noisy(compare.equal_samples(8), {name: integrators[name]}, tmp_path, seeds=2)
    setup = compare.SceneSetup(WHITE, reference=tmp_path / "reference.exr")
    comparison = compare.Comparison(
        setup, integrators, compare.equal_samples(8), folder=tmp_path, only_stored=True
    )
    (scene,) = comparison.run()["scenes"]
    ratios = scene["integrators"][1]["levels"][0]["ratios"]
    assert ratios["seconds"] is None and ratios["efficiency"] is None and ratios["relmse"]
    assert "second and first have no times of a common session" in scene["warnings"][1]
    assert len(scene["integrators"][1]["runs"]) == 2


def test_interruption_keeps_finished_results_and_says_so(clock, tmp_path, monkeypatch):
    integrators = {"noisy": noisy_integrator(clock)}
    comparison = compare.Comparison(
        WHITE, integrators, compare.equal_samples(8), folder=tmp_path, reference_spp=16
    )
    measure = experiment.Experiment._measure

    def interrupted(self, contender, index, round, path):
        if round == 2:
            raise KeyboardInterrupt
        return measure(self, contender, index, round, path)

    monkeypatch.setattr(experiment.Experiment, "_measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        comparison.run()
    stored = json.loads((tmp_path / "results.json").read_text())
    assert stored["state"] == "interrupted"
    assert len(stored["scenes"][0]["integrators"][0]["runs"]) == 2
    assert "nterrupted" in compare.write_report(tmp_path).read_text()
    monkeypatch.undo()
    # As the supervisor does after a second Ctrl-C: nothing is rendered
    comparison = compare.Comparison(
        WHITE, integrators, compare.equal_samples(8), folder=tmp_path, only_stored=True
    )
    monkeypatch.setattr(experiment.Experiment, "_timed", None)
    assert comparison.run()["scenes"] == stored["scenes"]
    assert comparison.results()["state"] == "interrupted"


@pytest.fixture
def small(clock):
    """A comparison in a temporary folder."""
    integrators = {"noisy": noisy_integrator(clock)}
    return compare.Comparison(WHITE, integrators, compare.equal_samples(4), reference_spp=16)


def test_progress_is_reported_unless_it_is_switched_off(small, capsys, monkeypatch):
    monkeypatch.setattr(progress, "PERIOD", 0.0)
    small.run()
    assert (small.folder / "results.json").is_file()  # in a temporary folder
    captured = capsys.readouterr()
    assert "scene: reference 50%\n" in captured.err and captured.out == ""
    steps = []
    for silent in (False, lambda step: steps.append(step.label)):
        small.run(progress=silent)
        assert capsys.readouterr() == ("", "")
    assert "scene: reference" in steps
    monkeypatch.setattr(progress.sys, "stderr", terminal := Terminal())
    small.run()
    assert "scene: reference" in terminal.getvalue()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    "scenes, integrators, options, message",
    [
        ([], ["path"], {}, "no scene"),
        (WHITE, [], {}, "no integrator"),
        (WHITE, ["path", "path"], {}, "given twice"),
        (WHITE, {"": "path"}, {}, "label of an integrator is empty"),
        (WHITE, ["path"], {"seeds": 0}, "seed"),
        ("none.xml", ["path"], {}, "no such scene"),
        (3, ["path"], {}, "a scene must be an XML file or a dict"),
        (WHITE, ["path"], {"folder": " "}, "name of the folder is empty"),
        (WHITE, ["path"], {"reference_integrator": "none"}, 'unknown integrator "none"'),
    ],
)
def test_bad_input_is_refused_at_once(scenes, integrators, options, message):
    with pytest.raises(InputError, match=message):
        compare.Comparison(scenes, integrators, compare.equal_samples(4), **options)


def test_a_text_that_is_no_budget_is_refused():
    for budget in (64, None, [4, 16], "64"):
        with pytest.raises(InputError, match=r"made by equal_samples\(64\), .* or until\(0.01\)"):
            compare.Comparison(WHITE, ["path"], budget)


@pytest.mark.parametrize(
    "make, value",
    [
        (compare.equal_samples, 0),
        (compare.equal_samples, 1.5),
        (compare.equal_time, 0),
        (compare.equal_time, float("nan")),
        (compare.sweep, []),
        (compare.sweep, [0, 1]),
        (compare.until, -1),
    ],
)
def test_budgets_without_sense_are_refused(make, value):
    with pytest.raises(InputError):
        make(value)
