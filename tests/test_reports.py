"""``mitsuba-ext render``: ``--quiet``, ``--json`` and ``--threads``."""

from __future__ import annotations

import json

import drjit as dr
import pytest

from mitsuba_ext.cli import long_job, reports

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture
def every_event(monkeypatch):
    monkeypatch.setattr(reports, "_PERIOD", 0.0)


def test_a_quiet_render_says_nothing_but_warnings(run, make_scene, tmp_path):
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
                   "seconds": end["seconds"], "bad_pixels": 0}  # fmt: skip
    assert {step["event"] for step in steps} == {"progress"} and len(steps) >= 3
    found = [step["spp"] for step in steps]
    assert found == sorted(set(found)) and found[-1] == 1 << 16
    assert steps[-2]["seconds_left"] > 0 == steps[-1]["seconds_left"]
    if options:
        assert steps[-1]["samples_per_second"] > 0 and steps[-1]["goal_spp"] == 1 << 16


def test_threads_are_those_of_all_processes(run, make_scene, tmp_path):
    before = dr.thread_count()
    try:
        assert run("render", make_scene(), "-o", tmp_path / "a.exr", "--threads", 3)[0] == 0
        assert dr.thread_count() == 3
    finally:
        dr.set_thread_count(before)
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--threads", 1)
    assert code == 2 and "1 is not in the range x>=2" in err
    job = long_job.LongJob(
        long_job.RenderRequest(str(make_scene()), threads=5), long_job.LongOptions(workers=2))
    assert job._request.threads == 5


def test_the_first_part_does_not_count_for_the_speed(monkeypatch):
    times = iter([10.0, 12.0, 14.0])
    monkeypatch.setattr(reports.time, "perf_counter", lambda: next(times))
    speed = reports.Speed()
    assert [speed(done) for done in (5, 9, 13)] == [None, 2, 2]
    assert reports.time_left(None) == "" and reports.time_left(61.2) == "about 0:01:01 left"
