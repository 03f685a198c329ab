"""Damaged images: of a comparison, which are made anew, and of users, which are named in a
sentence."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mitsuba_ext import compare
from mitsuba_ext.compare.references import stored_reference
from mitsuba_ext.compare.runs import Run, RunFolder
from mitsuba_ext.images import image_files
from tests.support.noisy import WHITE, noisy_integrator

pytestmark = pytest.mark.usefixtures("variant", "without_report")

_BALL = {"type": "sphere", "center": [0, 0, 5]}


def _damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A copy with a bit, a byte or a block that differs; mostly in the header."""
    copy = bytearray(data)
    at = int(rng.integers(len(data) if rng.random() < 0.5 else 1500))
    kind = rng.integers(3)
    length = 1 if kind < 2 else int(rng.integers(2, 64))
    copy[at : at + length] = (
        bytes([copy[at] ^ 1 << int(rng.integers(8))]) if kind == 0 else rng.bytes(length)
    )
    return bytes(copy)


def _figures(run: Run) -> dict[str, object]:
    return {**run.record(), "image": run.image().tobytes()}


def test_no_damaged_reference_or_run_is_taken_for_another(tmp_path):
    scene = compare.load_scene({**WHITE, "ball": _BALL}, keep_integrator=False)
    whole = compare.render_reference(scene, 16, tmp_path, "path")
    runs = RunFolder(tmp_path, {})
    run = Run(8, 0, 1, 8, 0.25, {"camera": 3}, None, 0.5, 100, 2)
    run = runs.save(run, whole.mean, tmp_path / "run.exr", {"integrator": "path"})
    first, rng, refused = _figures(run), np.random.default_rng(1), 0
    contents = {path: path.read_bytes() for path in (whole.path, run.path)}
    for _ in range(150):
        for path, data in contents.items():
            path.write_bytes(_damaged(data, rng))
        found, again = stored_reference(scene, tmp_path, "path"), runs.load(run.path)
        refused += (found is None) + (again is None)
        if found is not None:
            assert np.array_equal(found.mean, whole.mean) and found.spp == 16
            assert np.array_equal(found.variance, whole.variance)
        assert again is None or _figures(again) == first
    assert refused > 200  # of 300


def test_damaged_files_of_a_folder_are_named_and_made_anew(clock, tmp_path):
    integrator = {"noisy": noisy_integrator(clock)}

    def compared() -> tuple[dict, list[str]]:
        warned: list[str] = []
        comparison = compare.Comparison(
            {**WHITE, "ball": _BALL}, integrator, compare.equal_samples(8), seeds=2,
            folder=tmp_path, reference_spp=64, warn=warned.append,
        )  # fmt: skip
        return comparison.run(progress=False)["scenes"][0], warned

    before, warned = compared()
    assert not warned
    runs = before["integrators"][0]["runs"]
    reference, run = (tmp_path / x["path" if "noise" in x else "image"]
                      for x in (before["reference"], runs[1]))  # fmt: skip
    for path in (reference, run):
        data = bytearray(path.read_bytes())
        data[-5] ^= 4
        path.write_bytes(bytes(data))
    after, warned = compared()
    assert sorted(line.rsplit(": ", 1)[1] for line in warned) == [
        "the reference is rendered anew", "the run is measured anew",
    ]  # fmt: skip
    assert after["warnings"] == warned
    assert str(reference) in warned[0] and str(run) in warned[1]
    same = [x["integrators"][0]["levels"][0]["figures"]["relmse"] for x in (before, after)]
    assert same[0] == same[1]
    assert compared()[1] == []


def test_a_file_without_checksum_is_rendered_anew_but_read_where_it_is_named(tmp_path):
    scene = compare.load_scene(WHITE, keep_integrator=False)
    path = compare.render_reference(scene, 16, tmp_path).path
    channels, metadata = compare.read_exr(path)
    # Also if it was written with the metadata of another file
    compare.write_exr(path, np.stack(list(channels.values()), axis=2), list(channels),
                      {**metadata, "generatedBy": "another"})  # fmt: skip
    assert compare.load_reference(path).fault == ""
    del metadata["checksum"]
    image_files.write_exr_fast(path, channels, metadata)
    assert "earlier version" in compare.load_reference(path).fault
    warned = []
    compare.render_reference(scene, 16, tmp_path, warn=warned.append)
    assert len(warned) == 1 and "rendered anew" in warned[0]
    assert compare.load_reference(path).fault == ""


def test_damaged_times_of_other_sessions_are_not_used(tmp_path):
    runs = RunFolder(tmp_path, {})
    run = Run(8, 0, 1, 8, 0.25, {}, None, None, None, 2)
    run = runs.save(run, np.ones((2, 2, 3)), tmp_path / "run.exr", {})
    runs.add_time(run, 0.5)
    assert 0.5 in runs.load(run.path).timed_again.values()
    times = tmp_path / "run.times.json"
    times.write_text(times.read_text().replace("0.5", "0.4"))
    assert runs.load(run.path).timed_again == {}


@pytest.mark.parametrize("where", [b"Mitsuba version", b"channels"])
def test_a_damaged_header_of_a_users_image_is_named_in_a_sentence(where, run, make_scene, tmp_path):
    path = tmp_path / "image.exr"
    compare.write_exr(path, np.ones((6, 8, 3)), "RGB", {"about": "image"})
    data = path.read_bytes()
    at = data.index(where) + (0 if where != b"channels" else len(b"channels\0chlist\0") + 4)
    path.write_bytes(data[:at] + b"\xfb" + data[at + 1 :])
    other = tmp_path / "other.exr"
    compare.write_exr(other, np.full((6, 8, 3), 2.0), "RGB", {})
    commands = [["diff", path, other], ["diff", other, path],
                ["compare", make_scene(), "path", "--spp", 1, "--reference", path,
                 "--out", tmp_path / "out"]]  # fmt: skip
    for command in commands:
        code, _, err = run(*command)
        # A text of the header that is no UTF-8 does not make the image unreadable
        assert code in (0, 1) if where != b"channels" else code == 2
        assert err.count("\n") <= 1


def test_diff_says_that_an_image_was_changed_after_it_was_written(run, tmp_path):
    path = tmp_path / "image.exr"
    pixels = np.random.default_rng(1).random((6, 8, 3))
    compare.write_exr(path, pixels, "RGB", {"spp": 4})
    channels, metadata = compare.read_exr(path)
    image_files.write_exr_fast(path, {**channels, "R": channels["R"] * 2}, metadata)
    record = json.loads(run("diff", path, path, "--json")[1])
    assert "damaged, or edited" in record["remarks"]["image"][0]
    assert "damaged, or edited" in run("diff", path, path)[1]
