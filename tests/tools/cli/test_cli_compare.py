"""The command ``compare``: its output, and its errors for bad input."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from mitsuba_ext import cli
from mitsuba_ext.compare import load_reference, read_exr, write_exr
from mitsuba_ext.compare.experiment import Experiment, run_seed
from tests.support.command_line import SPHERE


def test_compare_writes_table_results_and_images(run, make_scene, tmp_path):
    out = tmp_path / "results"
    arguments = ("compare", make_scene(), "path", "prb:rr_depth=9", "--spp", 4, "--out", out)
    code, text, err = run(*arguments, "--seeds", 2, "--reference-spp", 256)
    assert (code, err) == (0, "")
    assert "prb:rr_depth=9" in text and "1.00x" in text

    results = json.loads((out / "results.json").read_text())
    assert results["schema"] == 2
    assert (results["seeds"], results["state"]) == (2, "finished")
    scene = results["scenes"][0]
    assert (scene["name"], scene["size"]) == (make_scene().parent.name, [8, 6])
    first, second = scene["integrators"]
    assert first["parameters"] == {"max_depth": 3, "rr_depth": 5}
    assert second["parameters"] == {"max_depth": 3, "rr_depth": 9}
    assert first["levels"][0]["ratios"]["efficiency"]["value"] == pytest.approx(1)
    assert len(second["runs"]) == 2
    assert second["runs"][1]["spp"] == 4
    # prb has another Russian roulette than path, but begins it beyond depth 3: the same numbers
    errors = [record["levels"][0]["figures"]["relmse"]["value"] for record in (first, second)]
    assert errors[0] == pytest.approx(errors[1], rel=0.05)
    assert scene["reference"]["noise"] > 0

    channels, metadata = read_exr(out / second["runs"][1]["image"])
    assert channels["G"].shape == (6, 8)
    assert (metadata["integrator"], metadata["seed"], metadata["spp"]) == ("prb", run_seed(0, 1), 4)


@pytest.mark.parametrize(
    "budget, kind, levels",
    [
        (["--sweep", "8,2"], "sweep", [2, 8]),
        (["--time", "0.05"], "time", [0.05]),
        (["--until", "0.02"], "until", None),
    ],
)
def test_every_budget_works(run, make_scene, tmp_path, budget, kind, levels, without_report):
    fragment = tmp_path / "mine.xml"
    fragment.write_text('<integrator type="direct"/>')
    out = tmp_path / "results"
    command = ["compare", make_scene(), "path", fragment, *budget, "--seeds", 2, "--out", out]
    code, text, err = run(*command, "--reference-spp", 20000)
    assert err == ""
    # The number of samples that fit into a time, and the noise of the reference, vary
    assert code == 0 or kind == "time"
    results = json.loads((out / "results.json").read_text())
    assert results["budget"]["kind"] == kind
    for record in results["scenes"][0]["integrators"]:
        assert record["error"] == ""
        found = [level["level"] for level in record["levels"]]
        assert found == levels if levels else found[0] == 8


def test_the_changes_of_a_scene_apply_to_all_its_images(
    run, make_scene, tmp_path, without_report
):
    command = ("compare", make_scene(), "path", "prb", "--spp", 2, "--seeds", 1, "--out", tmp_path,
               "--reference-spp", 64)  # fmt: skip
    changes = ("--size", "12x8", "--crop", "5x4+6+3", "--filter", "box", "--max-depth", 2)
    assert run(*command, *changes)[0] == 0
    (scene,) = json.loads((tmp_path / "results.json").read_text())["scenes"]
    assert scene["size"] == [5, 4] and scene["settings"]["max_depth"] == 2
    assert all(each["parameters"]["max_depth"] == 2 for each in scene["integrators"])
    # With another filter and depth, all is rendered again
    assert run(*command, *changes[:-4])[0] == 0
    assert len(list(tmp_path.glob("*/path_*.exr"))) == 2
    assert len(list(tmp_path.glob("references/*.exr"))) == 2


def test_no_reference_is_needed(run, make_scene, tmp_path):
    out = tmp_path / "o"
    command = ["compare", make_scene(), "path", "neepp", "--spp", 4, "--no-reference", "--cpu"]
    code, printed, _err = run(*command, "--out", out)
    assert code == 0
    assert "trimmed eff." in printed and "CPU time" in printed and "learned" in printed
    results = json.loads((out / "results.json").read_text())
    assert (results["errors"], results["clock"]) == ("between seeds", "cpu")
    assert "variances between the seeds" in (out / "report.html").read_text()


def test_several_scenes_are_compared_in_turn(run, make_scene, tmp_path):
    nearer = make_scene("nearer.xml", body=SPHERE.replace('z="5"', 'z="4"'))
    out = tmp_path / "results"
    command = ["compare", nearer, make_scene(), "path", "--spp", 2, "--seeds", 1, "--out", out]
    code, text, err = run(*command, "--reference-spp", 64)
    assert (code, err) == (0, "")
    results = json.loads((out / "results.json").read_text())
    assert [scene["name"] for scene in results["scenes"]] == ["nearer", tmp_path.name]
    assert f"{nearer}, 8x6, 2 spp" in text and f"{make_scene()}, 8x6, 2 spp" in text
    assert (out / "report.html").stat().st_size > 10_000


def test_progress_goes_to_a_file_line_by_line(
    run, make_scene, tmp_path, monkeypatch, without_report
):
    monkeypatch.setattr("mitsuba_ext.compare.progress.PERIOD", 0.0)
    command = ("compare", make_scene(), "path", "prb", "--spp", 4, "--seeds", 2)
    _, _, err = run(*command, "--reference-spp", 64, "--out", tmp_path)
    name = tmp_path.name
    assert f"{name}: reference 100%\n" in err and f"{name}: prb: compiling\n" in err
    assert re.search(rf"{name}: prb, about 0:00:0\d left\n", err)


def test_reference_that_is_too_noisy_ends_with_exit_code_1(run, make_scene, tmp_path):
    arguments = ("compare", make_scene(), "path", "--spp", 4096, "--seeds", 1, "--out", tmp_path)
    code, text, _ = run(*arguments, "--reference-spp", 64)
    assert code == 1 and "the reference is too noisy" in text


def test_rendered_reference_is_kept_until_the_scene_changes(
    run, make_scene, tmp_path, without_report
):
    out = tmp_path / "results"
    scene = make_scene()

    def references() -> dict[str, int]:
        run("compare", scene, "path", "--spp", 1, "--seeds", 1, "--reference-spp", 32, "--out", out)
        return {path.name: path.stat().st_mtime_ns for path in out.glob("references/*32spp.exr")}

    first = references()
    assert len(first) == 1
    assert references() == first
    scene.write_text(scene.read_text().replace('z="5"', 'z="6"'))
    assert len(references()) == 2


def test_rendered_reference_has_the_mean_and_its_variance(
    run, make_scene, tmp_path, without_report
):
    scene = make_scene()
    command = ("compare", scene, "path", "--spp", 1, "--seeds", 1, "--out", tmp_path)
    assert run(*command, "--reference-spp", 512)[0] == 0
    reference = load_reference(next(tmp_path.glob("references/*512spp.exr")))
    # The background is exact; the sphere is not
    assert reference.mean[0, 0] == pytest.approx(1)
    assert reference.variance[0, 0] == pytest.approx(0, abs=1e-10)
    assert reference.variance.max() > 1e-6


def test_images_with_variance_serve_as_reference_and_for_z(
    run, make_scene, tmp_path, without_report
):
    wrapper = tmp_path / "variance.json"
    wrapper.write_text(json.dumps({"type": "variance", "image": {"type": "path"}}))
    scene, paths = make_scene(), [tmp_path / "a.exr", tmp_path / "b.exr"]
    for seed, path in enumerate(paths):
        command = ("render", scene, "-o", path, "--integrator", wrapper, "--spp", 512)
        assert run(*command, "--seed", seed)[0] == 0
    record = json.loads(run("diff", "--json", *paths)[1])
    assert max(map(abs, record["z"])) < 4
    assert record["reference_noise"] > 0
    out = tmp_path / "out"
    command = ("compare", scene, "path", "--spp", 4, "--seeds", 1, "--out", out)
    assert run(*command, "--reference", paths[0])[0] == 0
    reference = json.loads((out / "results.json").read_text())["scenes"][0]["reference"]
    assert reference["noise"] == pytest.approx(record["reference_noise"], rel=0.5)


def test_plain_rgb_reference_is_accepted(
    run, make_scene, tmp_path, without_report
):
    path = tmp_path / "plain.exr"
    write_exr(path, np.ones((6, 8, 3)), "RGB", {})
    command = ("compare", make_scene(), "path", "--spp", 4, "--seeds", 1, "--out", tmp_path / "o")
    code, out, _ = run(*command, "--reference", path)
    assert code == 0 and "variance of the reference is unknown" in out


@pytest.mark.parametrize(
    "pixels, channels, message",
    [
        (np.ones((5, 8, 3)), "RGB", "8x5, but the scene renders 8x6"),
        (np.ones((6, 8, 1)), "Y", "found Y"),
        (np.zeros((6, 8, 3)), "RGB", "black"),
        (np.full((6, 8, 3), np.nan), "RGB", "48 of 48 pixels not finite"),
    ],
)
def test_unfit_reference_is_refused(run, make_scene, tmp_path, pixels, channels, message):
    path = tmp_path / "reference.exr"
    write_exr(path, pixels, channels, {})
    out = tmp_path / "o"
    code, _, err = run(
        "compare", make_scene(), "path", "--spp", 4, "--reference", path, "--out", out
    )
    assert code == 2
    assert message in err and str(path) in err and err.count("\n") == 1
    assert not out.exists()


def test_truncated_reference_is_one_line(make_scene, tmp_path, capfd):
    path = tmp_path / "reference.exr"
    write_exr(path, np.random.default_rng(0).random((6, 8, 3)), "RGB", {})
    path.write_bytes(path.read_bytes()[:-200])
    command = ["compare", make_scene(), "path", "--spp", 1, "--reference", path]
    assert cli.main([*map(str, command), "--out", str(tmp_path / "o")]) == 2
    captured = capfd.readouterr()  # also what libraries write past Python
    assert captured.out == "" and captured.err.count("\n") == 1
    assert f"{path}: unreadable" in captured.err


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["scene.xml", "", "--spp", "1"], 'integrator "": expected NAME'),
        (["scene.xml", " ", "--spp", "1"], 'integrator " ": expected NAME'),
        (["", "path", "--spp", "1"], "no scene was given"),
        (["scene.xml", "path", "--spp", "1", "--out", ""], "'--out': expected a path"),
        (["scene.xml", "path", "--spp", "1", "--reference", ""], "'--reference': expected a path"),
        (
            ["scene.xml", "path", "--spp", "1", "--reference-integrator", ""],
            'integrator "": expected NAME',
        ),
        (["scene.xml", "path", "--until", "0.1", "--no-reference"], "without a reference"),
        (
            ["scene.xml", "path", "--spp", "1", "--no-reference", "--reference-spp", "8"],
            "cannot be combined",
        ),
        (["scene.xml", "neepp:aovs=depth", "--spp", "1"], '"neepp": the parameter "aovs" must be'),
        (["scene.xml", "variance:a=[path", "--spp", "1"], 'found "[" without "]"'),
    ],
)
def test_bad_arguments_are_one_line(run, make_scene, tmp_path, monkeypatch, arguments, message):
    make_scene()
    monkeypatch.chdir(tmp_path)
    code, out, err = run("compare", *arguments)
    assert (code, out) == (2, "")
    assert message in err and err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_failing_integrator_is_a_row_and_does_not_stop_the_others(
    run, make_scene, tmp_path, without_report
):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    prb = type(mi.load_dict({"type": "prb"}))

    class Fails(prb):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            image = super().render(scene, sensor, seed, spp, develop, evaluate)
            return image * float("nan") if seed == run_seed(0, 1) else image

    mi.register_integrator("fails_in_round_1", lambda props: Fails(props))
    code, out, _ = run(
        "compare", make_scene(), "path", "fails_in_round_1", "--spp", 2, "--out", tmp_path
    )
    assert code == 1
    assert f"seed {run_seed(0, 1)}: 48 of 48 pixels not finite" in out
    path, fails = json.loads((tmp_path / "results.json").read_text())["scenes"][0]["integrators"]
    assert (len(path["runs"]), len(fails["runs"])) == (3, 1)
    assert fails["error"] and not path["error"]


def stored_runs(folder) -> list[int]:
    results = json.loads((folder / "out" / "results.json").read_text())
    return [len(record["runs"]) for record in results["scenes"][0]["integrators"]]


def test_interruption_reports_finished_results(run, make_scene, tmp_path, monkeypatch):
    measure = Experiment._measure

    def interrupted(self, contender, index, round, path):
        if round == 1:
            raise KeyboardInterrupt
        return measure(self, contender, index, round, path)

    monkeypatch.setattr(Experiment, "_measure", interrupted)
    command = ("compare", make_scene(), "path", "--spp", 2, "--reference-spp", 64)
    code, out, err = run(*command, "--out", tmp_path / "out")
    assert code == 130 and out.count("report.html") == 1
    assert err == "interrupted: the results cover only the finished runs\n"
    assert stored_runs(tmp_path) == [1] and (tmp_path / "out" / "report.html").is_file()


# ---- Processes that are interrupted, or die (tests/tools/cli/test_supervisor.py has the rest) ----

TROUBLE = """
import os, time
import mitsuba as mi
from mitsuba_ext.compare.experiment import run_seed

class Trouble(mi.SamplingIntegrator):  # without to_string(), which is optional
    def __init__(self, props):
        super().__init__(props)
        self.path = mi.load_dict({"type": "path", "max_depth": 2})

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        kind = os.environ["TROUBLE"] if seed == run_seed(0, 1) else ""
        if kind == "exit":
            os._exit(3)
        if kind == "hang":
            print("hanging", flush=True)
            time.sleep(600)
        return self.path.render(scene, sensor, seed, spp, develop, evaluate)

mi.register_integrator("trouble", lambda props: Trouble(props))
"""


@pytest.fixture
def troubled(make_scene, tmp_path):
    """Starts a comparison of ``path`` with an integrator that makes trouble in the second round;
    returns its process, and the arguments."""
    plugin = tmp_path / "trouble.py"
    plugin.write_text(TROUBLE)
    started = []

    def start(kind: str, *options) -> tuple[subprocess.Popen, list[str]]:
        arguments = [
            "compare", make_scene(), "path", "trouble", "--spp", 2, "--out", tmp_path / "out",
            "--plugin", plugin, *options,
        ]
        process = subprocess.Popen(
            [sys.executable, "-m", "mitsuba_ext", *map(str, arguments)],
            env={**os.environ, "TROUBLE": kind}, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process, arguments

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_integrator_that_takes_the_process_down_is_a_failed_row(
    run, troubled, tmp_path, monkeypatch
):
    process, arguments = troubled("exit")
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert out.count("the process ended with exit code 3 in this render") == 1
    assert err.count("continuing with the others") == 1
    assert stored_runs(tmp_path) == [3, 1]
    files = set(tmp_path.rglob("out/*/*.exr"))
    # The next comparison uses the finished runs
    monkeypatch.setenv("TROUBLE", "")
    assert run(*arguments)[0] == 0
    assert stored_runs(tmp_path) == [3, 3]
    assert len(set(tmp_path.rglob("out/*/*.exr")) - files) == 2


@pytest.mark.slow
def test_integrator_that_hangs_is_a_failed_row(troubled, tmp_path):
    process, _ = troubled("hang", "--limit", 15)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert out.count("a render took more than the 15 s of --limit") == 1
    assert err.count("continuing with the others") == 1
    assert stored_runs(tmp_path) == [3, 1]


def test_limit_needs_processes(run, make_scene):
    code, _, err = run("compare", make_scene(), "path", "--spp", 2, "--limit", 3)
    assert code == 2 and "--limit needs worker processes" in err


def test_end_of_the_supervisor_is_the_end_of_its_worker_and_lock(
    run, troubled, tmp_path, monkeypatch
):
    process, arguments = troubled("hang")
    assert process.stdout.readline() == "hanging\n"
    code, _, err = run(*arguments)
    assert code == 2 and f"(process {process.pid})" in err and err.count("\n") == 1
    process.kill()
    process.communicate(timeout=60)  # waits until the worker too has closed the pipe
    monkeypatch.setenv("TROUBLE", "")
    code, out, err = run(*arguments)
    assert (code, err) == (0, "")
    assert out.count("results.json") == 1
    assert stored_runs(tmp_path) == [3, 3]
