"""The report of a comparison: the content of its file."""

from __future__ import annotations

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_ext.compare import InputError, write_report
from mitsuba_ext.compare.report import crops, formats, pictures
from mitsuba_ext.images.image_files import write_exr
from tests.support.report_data import (
    HOSTILE,
    REFUSAL,
    estimate,
    make_results,
    make_scene,
    write,
    write_full,
)


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_full(tmp_path_factory.mktemp("report"))


class Document(HTMLParser):
    """The resources that an HTML file loads, its ids, and its text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.ids: list[str] = []
        self.scripts = 0
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        for name, value in attributes:
            if name in ("src", "href", "xlink:href", "srcset", "data", "action"):
                self.loads.append(value or "")
            elif name == "id":
                self.ids.append(value or "")

    def handle_data(self, data: str) -> None:
        self.text += data


# ---- The file ----


def test_report_is_one_file_that_loads_nothing(full: Path):
    html = (full / "report.html").read_text(encoding="utf-8")
    document = Document(html)
    assert document.loads
    assert all(value.startswith(("data:image/png;base64,", "#")) for value in document.loads)
    assert not re.search(r"@import|url\((?!#)", html)
    assert "http://" not in html and "https://" not in html
    assert len(document.ids) == len(set(document.ids)), "ids of the plots must not clash"
    anchors = {value[1:] for value in document.loads if value.startswith("#")}
    assert anchors <= set(document.ids)


def test_results_are_escaped_as_text(full: Path):
    html = (full / "report.html").read_text(encoding="utf-8")
    document = Document(html)
    assert document.scripts == 1
    assert "<script>alert" not in html
    assert HOSTILE in document.text


def test_the_report_begins_with_errors(full: Path):
    html = (full / "report.html").read_text(encoding="utf-8")
    top = Document(html[: html.index("<nav")]).text
    assert "Interrupted." in top
    assert f"broken failed: out of memory {HOSTILE}" in top
    assert "not measured: bad.xml: no such scene" in top
    assert "the reference has max_depth 6, the scene 8" in top
    assert REFUSAL in top


def test_finished_comparison_does_not_say_interrupted(tmp_path: Path):
    scene = make_scene(tmp_path, "one", (32, 32), [8], ["path"])
    html = write(tmp_path, make_results([scene], "spp", [8]))
    assert "Interrupted" not in html and 'class="notice' not in html


def test_figures_are_shown_with_their_intervals(full: Path):
    text = Document((full / "report.html").read_text(encoding="utf-8")).text
    assert "Figures at 64 samples per pixel" in text
    assert "2 other levels" in text
    # 1/64 ± 10 %
    assert "0.0156" in text and "0.0141–0.0172" in text
    assert "slope −1" in text and "(−1.10 to −0.900)" in text


def test_same_results_give_the_same_file(full: Path):
    before = (full / "report.html").read_bytes()
    assert write_report(full).read_bytes() == before


def test_the_main_table_shows_the_largest_common_level(tmp_path: Path):
    scene = make_scene(tmp_path, "one", (32, 32), [4, 16], ["path", "slow"])
    slow = scene["integrators"][1]
    slow["levels"].pop()
    slow["runs"] = slow["runs"][:2]
    assert "Figures at 4 samples per pixel" in write(
        tmp_path, make_results([scene], "sweep", [4, 16])
    )


@pytest.mark.parametrize(
    "kind, value, words",
    [
        ("time", 8, "8 s per run"), ("until", 0.01, "until relMSE 0.01 is reached"),
        ("spp", 8, "8 samples per pixel"),
    ],
)
def test_every_kind_of_budget_is_named(tmp_path: Path, kind: str, value: float, words: str):
    scene = make_scene(tmp_path, "one", (32, 32), [8], ["path", "other"])
    scene["integrators"][0]["target"] = {"spp": estimate(123), "seconds": None}
    html = write(tmp_path, make_results([scene], kind, [value]))
    assert words in html
    assert ("to reach relMSE 0.01" in html) == (kind == "until")


def forget_images(folder: Path, scene: dict[str, Any]) -> None:
    for file in folder.rglob("*.exr"):
        file.unlink()


def forget_reference(folder: Path, scene: dict[str, Any]) -> None:
    scene["reference"] = None


def forget_reference_file(folder: Path, scene: dict[str, Any]) -> None:
    (folder / "references/one.exr").unlink()


def damage_image(folder: Path, scene: dict[str, Any]) -> None:
    (folder / scene["integrators"][0]["runs"][-1]["image"]).write_bytes(b"no EXR")


def resize_image(folder: Path, scene: dict[str, Any]) -> None:
    write_exr(folder / scene["integrators"][0]["runs"][-1]["image"], np.ones((3, 3, 3)), "RGB", {})


def blacken_reference(folder: Path, scene: dict[str, Any]) -> None:
    write_exr(folder / "references/one.exr", np.zeros((32, 32, 3)), "RGB", {})


def forget_figures(folder: Path, scene: dict[str, Any]) -> None:
    for integrator in scene["integrators"]:
        for level in integrator["levels"]:
            level["figures"] = dict.fromkeys(level["figures"])
            level["ratios"] = {}
        for run in integrator["runs"]:
            run.update(relmse=None, seconds=0.0)


def forget_runs(folder: Path, scene: dict[str, Any]) -> None:
    for integrator in scene["integrators"]:
        integrator.update(runs=[], levels=[], error="failed early")


def forget_integrators(folder: Path, scene: dict[str, Any]) -> None:
    scene["integrators"] = []


def lose_errors_in_noise(folder: Path, scene: dict[str, Any]) -> None:
    for integrator in scene["integrators"]:
        for run in integrator["runs"]:
            run["relmse"] = -1e-9
        for level in integrator["levels"]:
            level["figures"]["relmse"] = {"value": -1e-9, "low": -1e-8, "high": 1e-8}


@pytest.mark.parametrize(
    "harm, words",
    [
        (forget_images, "no such file"), (forget_reference, ""),
        (forget_reference_file, "the reference is missing here"), (damage_image, "unreadable"),
        (resize_image, "is 3x3, the other images are 32x32"), (blacken_reference, ""),
        (forget_figures, ""), (forget_runs, "failed early"), (forget_integrators, ""),
        (lose_errors_in_noise, ""),
    ],
)
def test_a_report_is_written_if_files_are_missing(tmp_path: Path, harm: Callable, words: str):
    scene = make_scene(tmp_path, "one", (32, 32), [4, 16], ["path", "other"])
    harm(tmp_path, scene)
    assert words in write(tmp_path, make_results([scene], "sweep", [4, 16]))


def test_report_without_any_scene_says_so(tmp_path: Path):
    assert "Nothing was measured" in write(tmp_path, make_results([], "spp", [8]))


def test_unreadable_results_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="results.json: cannot be read"):
        write_report(tmp_path)
    (tmp_path / "results.json").write_text("{")
    with pytest.raises(InputError, match="is not JSON"):
        write_report(tmp_path)
    (tmp_path / "results.json").write_text('{"schema": 1}')
    with pytest.raises(InputError, match="schema 1, this version reads schema 2"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


# ---- Its parts ----


@pytest.mark.parametrize(
    "value, unit, text",
    [
        (0.0123456, formats.plain, "0.0123"), (4096, formats.plain, "4096"),
        (0, formats.plain, "0"), (1.234e-5, formats.plain, "1.23·10⁻⁵"),
        (9.999e-6, formats.plain, "1.00·10⁻⁵"), (-1.5, formats.plain, "−1.50"),
        (0.0123, formats.seconds, "12.3\u202fms"), (123.4, formats.seconds, "123\u202fs"),
        (12345678, formats.count, "12.3\u202fM"), (12, formats.count, "12"),
        (0.271828, formats.percent, "27.2\u202f%"), (1.5e9, formats.byte_count, "1.50\u202fGB"),
    ],
)
def test_numbers_have_three_digits_and_a_unit(value, unit, text):
    assert formats.figure({"value": value, "low": None, "high": None}, unit) == (text, "")


def test_interval_is_in_the_unit_of_its_value():
    interval = {"value": 1.2e-5, "low": 9e-6, "high": 1.5e-5}
    assert formats.figure(interval, formats.plain) == ("1.20·10⁻⁵", "0.900–1.50")
    interval = {"value": 84.7, "low": 5e-13, "high": 1e16}  # of a slope that is hardly known
    assert formats.figure(interval, formats.seconds) == ("84.7\u202fs", "5.00·10⁻¹³–1.00·10¹⁶")


def test_tone_map_is_srgb():
    gray = np.array([[[0.0, 0.18, 1.0]]])
    assert pictures.tone_map(gray, 1.0).tolist() == [[[0, 118, 255]]]
    assert pictures.tone_map(gray - 5, 2.0).tolist() == [[[0, 0, 0]]]


def test_windows_lie_where_the_integrators_differ():
    same = np.full((64, 128), 0.1)
    worse = same.copy()
    worse[16:32, 96:112] *= 100
    first, *others = crops.choose_windows([same, worse], 1e-6)
    assert first == (96, 16, 16)
    assert len(others) == 2
    windows = [first, *others]
    assert all(a.distance(b) >= a.side for a in windows for b in windows if a is not b)


@pytest.mark.parametrize("shape", [(1, 1), (16, 16), (1, 500), (500, 1), (20, 20)])
def test_small_images_have_no_windows(shape: tuple[int, int]):
    assert crops.choose_windows([np.ones(shape), np.zeros(shape)], 1e-6) == []
