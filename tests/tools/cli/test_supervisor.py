"""The supervisor of comparisons, with workers that are a few lines of Python."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_ext.cli import supervisor
from mitsuba_ext.compare import InputError
from mitsuba_ext.rendering import interrupts
from mitsuba_ext.util import marks

#: Code before the lines of each worker. A restarted worker runs the same lines.
WORKER = """
import json, os, signal, sys, time
from pathlib import Path
folder, job, parent = Path(sys.argv[1]), sys.argv[2], os.getppid()
mark = folder / "scene" / "a.running"
def begin(mark=mark):
    mark.parent.mkdir(exist_ok=True)
    mark.write_text(str(os.getpid()))
def log(text):
    with open(folder / "log", "a") as file:
        file.write(text + "\\n")
def wait(number, then=None):  # for a signal, after asking the supervisor for it
    signal.signal(number, then or (lambda *_: sys.exit(130)))
    os.kill(parent, SIGNAL)
    time.sleep(8)
log(job)
"""


@pytest.fixture
def supervise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs workers of the given lines; returns the exit code and the jobs that they had."""

    def run(
        lines: str, number: int = signal.SIGTERM, **options: float
    ) -> tuple[int, list[str]]:
        code = WORKER.replace("SIGNAL", str(int(number))) + lines
        monkeypatch.setattr(
            supervisor, "_command", lambda _arguments, job:
            [sys.executable, "-S", "-c", code, str(tmp_path), job],
        )
        result = supervisor.supervise([], tmp_path, **options)
        return result, (tmp_path / "log").read_text().split()

    return run


@pytest.mark.parametrize("code", [0, 1, 2, 130])
def test_a_worker_that_ends_in_order_ends_everything(supervise, tmp_path, capfd, code):
    # The mark of another process: no integrator is blamed
    lines = f"mark.parent.mkdir(); mark.write_text('1'); sys.exit({code})"
    assert supervise(lines) == (code, ["measure"])
    assert capfd.readouterr().err == ""
    assert [path.suffix for path in (tmp_path / "scene").iterdir()] == [".running"]


@pytest.mark.parametrize(
    "end, words",
    [("os.abort()", "died of SIGABRT"), ("os._exit(3)", "ended with exit code 3"),
     ("os._exit(0)", "ended with exit code 0")],
)
def test_worker_that_dies_in_a_render_is_followed_by_another(supervise, capfd, end, words):
    lines = f"if mark.with_suffix('.crashed').exists(): sys.exit(1)\nbegin(); {end}"
    assert supervise(lines) == (1, ["measure", "measure"])
    assert f"the process {words}; continuing with the others" in capfd.readouterr().err


def test_render_that_takes_too_long_is_ended_and_followed_by_others(supervise, tmp_path, capfd):
    lines = "if mark.with_suffix('.crashed').exists(): sys.exit(1)\nbegin(); time.sleep(20)"
    assert supervise(lines, limit=0.2) == (1, ["measure", "measure"])
    assert "took more than the 0.2 s of --limit for a render, and was stopped; continuing" in (
        capfd.readouterr().err)
    crashed = tmp_path / "scene" / "a.crashed"
    assert crashed.read_text() == "a render took more than the 0.2 s of --limit"


def test_the_limit_applies_to_each_render_but_not_to_references(supervise):
    lines = """
begin()
for _ in range(8):
    time.sleep(0.1)
    os.utime(mark)
mark.unlink()
begin(folder / "references" / "b.running")
time.sleep(0.8)
os.remove(folder / "references" / "b.running")
"""
    assert supervise(lines, limit=0.5)[1] == ["measure"]


def test_a_worker_that_dies_again_and_again_is_abandoned(supervise, capfd):
    assert supervise("begin(); os._exit(3)") == (1, ["measure", "measure"])
    assert "exit code 3 in the same render again: given up" in capfd.readouterr().err


@pytest.mark.parametrize("end, code", [("os.abort()", 1), ("os._exit(3)", 3)])
def test_a_worker_that_dies_outside_of_renders_ends_all_with_a_message(supervise, capfd, end, code):
    assert supervise(end) == (code, ["measure"])
    assert capfd.readouterr().err.startswith("mitsuba-ext: the process ")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_interrupt_the_worker_which_reports(supervise, number):
    before = signal.getsignal(number)
    assert supervise("begin(); wait(signal.SIGINT)", number) == (128 + number, ["measure"])
    assert signal.getsignal(number) == before


def test_a_render_that_ignores_signals_is_abandoned_after_sigterm(supervise, capfd, monkeypatch):
    monkeypatch.setattr(supervisor, "GRACE", 0.1)
    lines = "if job == 'stored': sys.exit(130)\nbegin(); wait(signal.SIGINT, signal.SIG_IGN)"
    assert supervise(lines) == (143, ["measure", "stored"])
    assert "the running render is given up" in capfd.readouterr().err


def test_after_sigterm_the_supervisor_waits_for_the_report(supervise, monkeypatch):
    monkeypatch.setattr(supervisor, "GRACE", 0.05)
    lines = "wait(signal.SIGINT, lambda *_: (time.sleep(0.3), log('written'), os._exit(130)))"
    assert supervise(lines) == (143, ["measure", "written"])


def test_signals_that_come_together_do_not_kill_the_worker_that_reports(supervise):
    lines = """
os.kill(parent, signal.SIGHUP)
wait(signal.SIGINT, lambda *_: (time.sleep(0.3), log('written'), os._exit(130)))
"""
    code, jobs = supervise(lines)
    # On a busy machine the two may be delivered at once, and then in any order
    assert code in (128 + signal.SIGHUP, 128 + signal.SIGTERM)
    assert jobs == ["measure", "written"]


def test_the_worker_obeys_its_supervisor_where_ctrl_c_is_ignored(supervise):
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        lines = "sys.exit(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
        assert supervise("os.kill(parent, signal.SIGINT); time.sleep(0.3); " + lines) == (
            0, ["measure"]
        )
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, previous)


def test_a_second_interrupt_abandons_the_running_render(supervise, capfd, monkeypatch):
    monkeypatch.setattr(interrupts, "TOGETHER", 0.0)
    lines = """
if job == 'stored': sys.exit(130)
begin()
wait(signal.SIGINT, lambda *_: os.kill(parent, signal.SIGINT))
"""
    assert supervise(lines, signal.SIGINT) == (130, ["measure", "stored"])
    err = capfd.readouterr().err
    assert "waiting for the running render" in err and "is given up" in err


def test_the_worker_is_interrupted_once_and_not_by_signals_that_nohup_ignores():
    lines = """
import os, signal, time
from mitsuba_ext.cli import supervisor
signal.signal(signal.SIGHUP, signal.SIG_IGN)
supervisor.become_worker()
os.kill(os.getpid(), signal.SIGHUP)
try:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5)
except KeyboardInterrupt:
    os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGTERM)
    print("report")
"""
    done = subprocess.run(
        [sys.executable, "-c", lines], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout) == (0, "report\n"), done.stderr


# ---- One comparison in a folder ----

HOLD = """
import fcntl, os, sys, time
file = open(sys.argv[1], "a+")
fcntl.flock(file, fcntl.LOCK_EX)
file.write(str(os.getpid())); file.flush()
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path):
    """A process that has locked the folder."""
    process = subprocess.Popen(
        [sys.executable, "-S", "-c", HOLD, str(tmp_path / ".lock")],
        stdout=subprocess.PIPE, text=True,
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_folder_in_use_is_refused_until_its_process_is_gone(holder, tmp_path, monkeypatch):
    with pytest.raises(InputError, match=rf"another process .* \(process {holder.pid}\)"):
        with marks.in_use(tmp_path):
            pass
    with monkeypatch.context() as patch:  # a worker, whose supervisor holds the lock
        patch.setenv(marks.SESSION_VARIABLE, "session")
        with marks.in_use(tmp_path):
            pass
    holder.kill()
    holder.wait()
    assert (tmp_path / ".lock").exists()
    with marks.in_use(tmp_path):
        assert (tmp_path / ".lock").read_text() == str(os.getpid())
        with pytest.raises(InputError, match=f"process {os.getpid()}"), marks.in_use(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_marks_of_a_process_that_is_gone_are_removed(tmp_path):
    mark = marks.mark_of(tmp_path / "scene", "path:max_depth=3")
    with marks.marked(mark):
        marks.blame(tmp_path, os.getpid(), "it died")
    with pytest.raises(RuntimeError, match="it died"), marks.marked(mark):
        pass
    assert marks.has_crashed(mark)
    with marks.in_use(tmp_path), marks.marked(mark):
        pass
    assert not list((tmp_path / "scene").iterdir())


def test_a_folder_that_stayed_empty_is_removed(tmp_path):
    with marks.in_use(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not (tmp_path / "a").exists()
    with marks.in_use(tmp_path / "a"):
        (tmp_path / "a" / "results.json").touch()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["results.json"]
