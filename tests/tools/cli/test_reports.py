"""``mitsuba-ext render``: ``--quiet``, ``--json`` and ``--threads``."""

from __future__ import annotations

import json

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.cli import long_job, reports, statistics
from mitsuba_ext.compare import read_exr
from mitsuba_ext.rendering.totals import RenderTotals

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def every_event(monkeypatch):
    monkeypatch.setattr(reports, "_PERIOD", 0.0)


def test_a_quiet_render_prints_warnings_only(run, make_scene, tmp_path):
    command = ("render", make_scene(), "--quiet", "-o")
    assert run(*command, tmp_path / "a.exr") == (0, "", "")
    assert run(*command, tmp_path / "a.exr", "--until", "1") == (0, "", "")
    code, out, err = run(*command, tmp_path / "b.exr", "--integrator", "nothing")
    assert code == 2 and not out and err.count("\n") == 1


@pytest.mark.parametrize("options", [(), ("--until", "1e-9")])
def test_a_script_reads_events(run, make_scene, tmp_path, every_event, options):
    target = tmp_path / "a.exr"
    code, out, err = run(
        "render", make_scene(), "-o", target, "--spp", 1 << 16, "--json", *options)
    events = [json.loads(line) for line in out.splitlines()]
    assert code == 0 and not err
    *steps, end = events
    assert end == {"event": "end", "interrupted": False, "file": str(target), "spp": 1 << 16,
                   "seconds": end["seconds"], "bad_pixels": 0,
                   "statistics": end["statistics"]}  # fmt: skip
    assert end["statistics"]["rays"] == {"camera": 48 << 16}
    assert {step["event"] for step in steps} == {"progress"} and len(steps) >= 3
    found = [step["spp"] for step in steps]
    assert found == sorted(set(found)) and found[-1] == 1 << 16
    assert steps[-2]["seconds_left"] > 0 == steps[-1]["seconds_left"]
    assert steps[-1]["samples_per_second"] > 0
    if options:
        assert steps[-1]["goal_spp"] == 1 << 16 and steps[-1]["batches"] == len(steps)


@pytest.mark.usefixtures("batches_of_sixteen_samples")
def test_the_error_is_shown_by_default(run, make_scene, tmp_path, every_event):
    out = run("render", make_scene(), "-o", tmp_path / "a.exr", "--spp", 160, "--json",
              "--checkpoint", tmp_path / "kept")[1]  # fmt: skip
    *steps, _ = (json.loads(line) for line in out.splitlines())
    assert [step["batches"] for step in steps] == list(range(1, 11))
    assert "relmse" not in steps[6] and 0 < steps[9]["relmse"] < 1


def test_the_output_contains_only_events(run, make_scene, tmp_path):
    """Mitsuba prints its warnings to stdout, and so may a module of the user."""
    module = tmp_path / "loud.py"
    module.write_text(
        "import mitsuba as mi\nprint('printed')\nmi.Log(mi.LogLevel.Warn, 'a thing')\n"
        "mi.Log(mi.LogLevel.Info, 'another')\n"
    )
    command = ("render", make_scene(), "-o", tmp_path / "a.exr", "--plugin", module)
    code, out, err = run(*command, "--json")
    warning, *_, end = (json.loads(line) for line in out.splitlines())
    assert code == 0 and err == "printed\n" and end["event"] == "end"
    assert warning["event"] == "warning" and warning["text"].endswith("a thing")
    before = mi.logger().appender(0)
    assert run(*command)[1].startswith("printed") and mi.logger().appender(0) is before


@pytest.mark.parametrize(("integrator", "options"), [
    ("path", ()), ("neepp:grid=4", ()), ("neepp:grid=4", ("--until", "1e-9")),
])  # fmt: skip
def test_a_render_shows_and_keeps_its_cost(run, make_scene, tmp_path, integrator, options):
    target = tmp_path / "a.exr"
    command = ("render", make_scene(), "-o", target, "--integrator", integrator, "--spp", 256,
               "--seed", 5, *options)  # fmt: skip
    code, out, _ = run(*command)
    assert code == 0 and "256 spp in" in out.splitlines()[0]
    metadata = read_exr(target)[1]
    name, is_ours = integrator.partition(":")[0], integrator != "path"
    assert metadata["integrator"] == name and metadata["seed"] == 5
    found = json.loads(metadata["statistics"])
    assert found["rays"]["camera"] == 48 * 256 and found["memory_bytes"] > 0
    assert found["render_seconds"] > 0
    assert f"{name}, seed 5, llvm_ad_rgb, mitsuba_ext" in out and "12.3 thousand from the" in out
    if is_ours:
        assert found["rays"]["shadow"] > 0 < found["learning_seconds"] and found["learned"]
        assert f"learned: {found['learned']}" in out and " to lights" in out
    code, out, _ = run(*command, "--json", "--spp", 256)
    end = json.loads(out.splitlines()[-1])["statistics"]
    assert end["integrator"] == name and end["seeds"] == [5] and end["rays"] == found["rays"]
    assert end["versions"]["variant"] == "llvm_ad_rgb"


def test_costs_add_up():
    one = RenderTotals({"camera": 2}, 3, 1.0, 0.5, 0.25, 7, "a", {"directions": {"is_kept": True}})
    # A batch that uses what the first one learned knows no figures
    two = RenderTotals(
        {"camera": 1, "shadow": 4}, 1, 1.0, 0.0, 0.0, 5, "", {"directions": {}})  # fmt: skip
    both = one.plus(two)
    assert both == RenderTotals(
        {"camera": 3, "shadow": 4}, 4, 2.0, 0.5, 0.25, 7, "a", one.effects)  # fmt: skip
    assert RenderTotals(**json.loads(json.dumps(both.known()))) == both
    assert RenderTotals().known() == {}
    many = statistics.lines(RenderTotals(), "path", range(9), {
        "variant": "v", "mitsuba_ext": "1", "mitsuba": "3"})  # fmt: skip
    assert many == ["  path, seeds 0, 1, 2, 3, …, v, mitsuba_ext 1, Mitsuba 3"]


def test_threads_are_counted_over_all_processes(run, make_scene, tmp_path):
    before = dr.thread_count()
    try:
        assert run("render", make_scene(), "-o", tmp_path / "a.exr", "--threads", 3)[0] == 0
        assert dr.thread_count() == 3
    finally:
        dr.set_thread_count(before)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--threads", 1)
    assert code == 2 and "1 is not in the range 2<=x<=" in err
    job = long_job.LongJob(
        long_job.RenderRequest(str(make_scene()), threads=5), long_job.LongOptions(workers=2))
    assert job._request.threads == 5


def test_the_first_part_does_not_count_for_the_speed(monkeypatch):
    times = iter([10.0, 12.0, 14.0])
    monkeypatch.setattr(reports.time, "perf_counter", lambda: next(times))
    speed = reports.Speed()
    assert [speed(done) for done in (5, 9, 13)] == [None, 2, 2]
    assert reports.time_left(None) == "" and reports.time_left(61.2) == "about 0:01:01 left"


def test_progress_of_frames_names_their_images(run, make_scene, tmp_path, every_event):
    out = run("render", make_scene(), "-o", tmp_path / "a.##.exr", "--spp", 16, "--json",
              "--frames", "3:5")[1]  # fmt: skip
    steps = [json.loads(line) for line in out.splitlines()]
    steps = [step for step in steps if step["event"] == "progress"]
    named = {(step["frame"], step["file"]) for step in steps}
    assert named == {(n, str(tmp_path / f"a.0{n}.exr")) for n in {n for n, _ in named}}
    assert {3, 4} <= {n for n, _ in named}
