"""Signals that end ``mitsuba-ext render``: the image keeps the passes that are complete."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import time

import click
import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_ext.cli.stopping import Stop, stopping
from mitsuba_ext.compare import read_exr
from mitsuba_ext.images import image_files
from mitsuba_ext.rendering import device, interrupts, plan, seed_passes
from mitsuba_ext.rendering import render as rendering


@pytest.fixture
def interrupted_integrator():
    """An integrator that Ctrl-C ends after the image (seed 0) or before it (other seeds)."""
    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))

    class Interrupted(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if seed == 0:
                super().render(scene, sensor, seed, spp, develop, evaluate)
            raise KeyboardInterrupt

    mi.register_integrator("interrupted", lambda props: Interrupted(props))
    return "interrupted"


def test_an_interrupted_render_writes_the_content_of_the_film(
    run, make_scene, tmp_path, interrupted_integrator
):
    output = tmp_path / "image.exr"
    arguments = ("render", make_scene(), "-o", output, "--integrator", interrupted_integrator)
    code, _, err = run(*arguments)
    assert code == 130
    assert err.splitlines()[0] == f"interrupted during the render: {output}"
    assert read_exr(output)[0]["R"].shape == (6, 8)


@pytest.mark.parametrize("when", [("--seed", "1"), ("--time", "5")])
def test_render_interrupted_before_its_first_pass_leaves_an_older_file_alone(
    run, make_scene, tmp_path, interrupted_integrator, when
):
    output = tmp_path / "image.exr"
    output.write_bytes(b"older")
    arguments = ("render", make_scene(), "-o", output, "--integrator", interrupted_integrator)
    code, _, err = run(*arguments, *when)
    assert code == 130
    assert err.count("\n") == 1 and "nothing written" in err
    assert output.read_bytes() == b"older"


@pytest.fixture(params=["path", "composed_path"])
def third_pass_gets(request, monkeypatch):
    """What makes every third pass of 4 samples get signals, 10 ms from each other; returns the
    integrator."""
    samples = 4 * 8 * 6
    if request.param == "path":
        job, name, lengths = seed_passes.SeedPasses, "_run_pass", seed_passes
        monkeypatch.setattr(seed_passes, "_PASS_SAMPLES", {dr.JitBackend.LLVM: samples})
    else:
        job, name, lengths = rendering.Job, "run_pass", plan
        monkeypatch.setattr(device, "_CPU_SAMPLES", samples)
    monkeypatch.setattr(lengths, "_PASS_SPP", 1)
    run_pass, passes = getattr(job, name), []

    def set_signals(*names: str) -> str:
        def interrupted(self, *arguments):
            passes.append(self)
            for name in names if len(passes) % 3 == 0 else ():
                os.kill(os.getpid(), getattr(signal, name))
                time.sleep(0.01)
            return run_pass(self, *arguments)

        monkeypatch.setattr(job, name, interrupted)
        return request.param

    return set_signals


@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_a_signal_ends_the_render_after_a_pass_and_keeps_an_older_image(
    run, make_scene, tmp_path, third_pass_gets, name, code
):
    integrator = third_pass_gets(name)
    output, partial = tmp_path / "image.exr", tmp_path / "image.partial.exr"
    arguments = ("render", make_scene(), "-o", output, "--integrator", integrator, "--spp", 40)
    for target in (output, partial):
        found, _, err = run(*arguments)
        assert found == code
        assert f"interrupted after 12 of 40 spp: {target}" in err
        metadata = read_exr(target)[1]
        assert (metadata["spp"], metadata["interrupted"]) == (12, "true")
    assert f"{output} is an older image" in err
    assert sorted(tmp_path.iterdir()) == [output, partial, tmp_path / "scene.xml"]
    for wanted in (["--spp", 12], ["-D", "spp=12"]):
        assert run(*arguments[:-2], *wanted)[0] == 0, "the last pass had all samples"
        assert read_exr(output)[1]["interrupted"] == "false"


@pytest.mark.parametrize("names", [("SIGHUP", "SIGTERM", "SIGINT"), ("SIGINT", "SIGINT")])
def test_signals_at_the_same_time_count_as_one(
    run, make_scene, tmp_path, third_pass_gets, names
):
    """They come from a closed terminal, for example, where printing fails too."""
    output, integrator = tmp_path / "a.exr", third_pass_gets(*names)
    code, _, err = run(
        "render", make_scene(), "-o", output, "--integrator", integrator, "--spp", 40
    )
    assert code == 128 + getattr(signal, names[0]) and "after 12 of 40 spp" in err
    assert read_exr(output)[1]["spp"] == 12


def test_a_second_signal_that_python_handles_late_does_nothing():
    """Handlers run after native code, so the time between two calls of a handler is not the time
    between two signals."""
    stop = Stop()
    with pytest.raises(KeyboardInterrupt):
        stop(signal.SIGHUP, None)
    stop._time -= 100
    stop(signal.SIGTERM, None)
    assert stop.exit_code == 129


def test_terminal_that_is_closed_keeps_the_image_and_the_exit_code(
    run, make_scene, tmp_path, third_pass_gets, monkeypatch
):
    def gone(*_, **__):
        raise OSError(errno.EIO, "Input/output error")

    output, integrator = tmp_path / "a.exr", third_pass_gets("SIGHUP")
    monkeypatch.setattr(click, "echo", gone)
    arguments = ("render", make_scene(), "-o", output, "--integrator", integrator, "--spp", 40)
    assert run(*arguments)[0] == 129
    assert read_exr(output)[1]["spp"] == 12


def test_signals_do_not_interrupt_the_writing_of_the_image(
    run, make_scene, tmp_path, third_pass_gets, monkeypatch
):
    integrator, write, exits = third_pass_gets("SIGTERM"), image_files.write_film, []
    monkeypatch.setattr(interrupts, "TOGETHER", 0.02)
    monkeypatch.setattr(os, "_exit", exits.append)

    def interrupted(path, film, metadata, *others, **options):
        for name in ("SIGTERM", "SIGINT") if metadata else ():  # else it is the trial
            time.sleep(0.05)
            os.kill(os.getpid(), getattr(signal, name))
        time.sleep(0.05)
        write(path, film, metadata, *others, **options)

    monkeypatch.setattr(image_files, "write_film", interrupted)
    output = tmp_path / "a.exr"
    arguments = ("render", make_scene(), "-o", output, "--integrator", integrator, "--spp", 40)
    assert (run(*arguments)[0], exits) == (143, [])
    assert read_exr(output)[1]["spp"] == 12


def test_ignored_signals_stay_ignored():
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts.deferred_interrupt():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        with stopping() as stop, interrupts.deferred_interrupt() as interrupt:
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGTERM)
            assert interrupt.is_set() and stop.exit_code == 143
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, previous)


def test_a_second_signal_always_ends_the_process(run, make_scene, tmp_path, monkeypatch):
    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))
    exits: list[int] = []

    class Stubborn(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            while not exits:
                with contextlib.suppress(KeyboardInterrupt):
                    os.kill(os.getpid(), signal.SIGINT)
                    time.sleep(0.01)
            raise KeyboardInterrupt

    mi.register_integrator("stubborn", lambda props: Stubborn(props))
    monkeypatch.setattr(interrupts, "TOGETHER", 0.02)
    monkeypatch.setattr(os, "_exit", exits.append)
    arguments = ("render", make_scene(), "-o", tmp_path / "a.exr", "--integrator", "stubborn")
    assert run(*arguments)[0] == 130 and exits[0] == 130
    assert not (tmp_path / "a.exr").exists()
