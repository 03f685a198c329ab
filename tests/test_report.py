"""The report of a comparison: what its file says, and how it behaves in a browser.

The folders are synthetic: images of a known reference with noise of a known variance.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mitsuba_ext.compare import InputError, metrics, write_report
from mitsuba_ext.compare.images import write_exr
from mitsuba_ext.compare.report import crops, formats, pictures

HOSTILE = '<script>alert(1)</script>"\'&'
REFUSAL = "the reference is too noisy: its own relMSE is 0.1"


def estimate(value: float | None, spread: float = 0.1) -> dict[str, float] | None:
    if value is None:
        return None
    return {"value": value, "low": value - spread * abs(value), "high": value + spread * abs(value)}


def make_integrator(
    folder: Path, label: str, scene: str, reference: np.ndarray, noise: float, levels: list[int]
) -> dict[str, Any]:
    """An integrator with two runs per level, whose images are the reference with noise."""
    rng = np.random.default_rng(len(label))
    runs = []
    for level in levels:
        for seed in range(2):
            scale = noise / level**0.5
            image = reference * (1 + scale * rng.standard_normal(reference.shape))
            name = f"{scene}/{re.sub(r'[^a-z]', '_', label)}_{level}_{seed}.exr"
            (folder / scene).mkdir(exist_ok=True)
            write_exr(folder / name, image, "RGB", {})
            runs.append({
                "level": level, "seed": seed, "spp": level, "seconds": level / 100 + 0.01 * seed,
                "relmse": metrics.relative_mse(image, reference), "relmse_trimmed": scale**2,
                "mse": scale**2, "rmse": scale, "sigma_mu": scale, "flip": None,
                "rays": {}, "connections": None, "zero_radiance": None, "memory": None,
                "launches": None, "image": name,
            })
    unknown = dict.fromkeys(("rays", "shadow_share", "zero_radiance", "memory", "launches"))
    return {
        "label": label, "name": "path", "parameters": {}, "error": "", "notes": [],
        "compile_seconds": 0.5, "runs": runs,
        "levels": [
            {
                "level": level, "run_count": 2, "refused": "",
                "figures": {
                    "spp": estimate(level, 0), "seconds": estimate(level / 100),
                    **dict.fromkeys(
                        ("relmse", "relmse_trimmed", "mse", "rmse", "sigma_mu"),
                        estimate(noise**2 / level),
                    ),
                    "flip": None, "efficiency": estimate(100 / noise**2), **unknown,
                },
                "ratios": dict.fromkeys(
                    ("seconds", "relmse", "relmse_trimmed", "efficiency"), estimate(1 / noise)
                ),
            }
            for level in levels
        ],
        "slopes": dict.fromkeys(("spp", "seconds"), estimate(-1) if len(levels) > 1 else None),
        "target": None,
    }


def make_scene(
    folder: Path, name: str, size: tuple[int, int], levels: list[int], labels: list[str]
) -> dict[str, Any]:
    width, height = size
    y, x = np.mgrid[:height, :width]
    reference = np.stack([1 + x, 1 + y, 1 + x + y], axis=2) / (width + height)
    (folder / "references").mkdir(exist_ok=True)
    write_exr(folder / f"references/{name}.exr", reference, "RGB", {})
    return {
        "name": name, "path": f"/scenes/{name}.xml", "parameters": {}, "content_hash": "0",
        "size": [width, height], "settings": {"max_depth": 6}, "error": "", "warnings": [],
        "reference": {
            "path": f"references/{name}.exr", "noise": None, "spp": None, "integrator": None,
            "seconds": None, "metadata": {},
        },
        "integrators": [
            make_integrator(folder, label, name, reference, 1 / (1 + index), levels)
            for index, label in enumerate(labels)
        ],
    }


def make_results(scenes: list[dict[str, Any]], kind: str, values: list[float]) -> dict[str, Any]:
    return {
        "schema": 2, "date": "2026-01-02T03:04:05+00:00", "command": "mitsuba-ext compare …",
        "state": "finished", "budget": {"kind": kind, "values": values}, "seeds": 2,
        "scenes": scenes, "versions": {"mitsuba": "3.9.1"},
        "machine": {"system": "Linux", "processor": "a processor", "cores": 2},
    }


def write(folder: Path, results: dict[str, Any]) -> str:
    """Writes the results and their report; the HTML."""
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    path = write_report(folder)
    assert path == folder / "report.html"
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a report of everything that can happen in one comparison."""
    folder = tmp_path_factory.mktemp("report")
    large = make_scene(folder, "large", (96, 64), [4, 16, 64], ["path", HOSTILE, "better"])
    large["integrators"][1]["levels"][0].update(refused=REFUSAL)
    for name in ("relmse", "relmse_trimmed", "mse", "rmse", "sigma_mu"):
        large["integrators"][1]["levels"][0]["figures"][name] = None
    large["warnings"] = ["the reference has max_depth 6, the scene 8"]
    broken = make_integrator(folder, "broken", "large", np.ones((64, 96, 3)), 1.0, [])
    broken["error"] = f"out of memory {HOSTILE}"
    large["integrators"].append(broken)
    tiny = make_scene(folder, "tiny", (1, 1), [4, 16, 64], ["path", "better"])
    bad = make_scene(folder, "bad", (8, 8), [], [])
    bad.update(error="bad.xml: no such scene", reference=None)
    results = make_results([large, tiny, bad], "sweep", [4, 16, 64])
    write(folder, {**results, "state": "interrupted"})
    return folder


class Document(HTMLParser):
    """What an HTML file loads, its ids, and its text."""

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


def test_what_comes_from_results_is_text(full: Path):
    html = (full / "report.html").read_text(encoding="utf-8")
    document = Document(html)
    assert document.scripts == 1
    assert "<script>alert" not in html
    assert HOSTILE in document.text


def test_report_says_first_what_went_wrong(full: Path):
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


def test_figures_stand_with_their_intervals(full: Path):
    text = Document((full / "report.html").read_text(encoding="utf-8")).text
    assert "Figures at 64 samples per pixel" in text
    assert "2 other levels" in text
    # 1/64 ± 10 %
    assert "0.0156" in text and "0.0141–0.0172" in text
    assert "slope −1" in text and "(−1.10 to −0.900)" in text


def test_same_results_give_the_same_file(full: Path):
    before = (full / "report.html").read_bytes()
    assert write_report(full).read_bytes() == before


def test_main_table_is_of_the_largest_level_that_all_have(tmp_path: Path):
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
def test_report_is_written_whatever_is_missing(tmp_path: Path, harm: Callable, words: str):
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


# ---- In a browser ----


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    names = ("chromium", "chromium-browser", "google-chrome")
    executable = next(filter(None, map(shutil.which, names)), None)
    if executable is None:
        reason = f"needs a browser: none of {', '.join(names)} is installed"
        pytest.fail(reason) if os.environ.get("CI") else pytest.skip(reason)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        # A sandbox of its own is what root, and most containers, do not get
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Any, full: Path) -> Iterator[Any]:
    """The report in a browser; complaints of any kind fail the test."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(5000)
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: (complaints.append(dialog.message), dialog.dismiss()))
    page.on("request", lambda request: complaints.append(request.url)
            if not request.url.startswith(("file:", "data:")) else None)
    page.goto((full / "report.html").as_uri())
    yield page
    page.close()
    assert complaints == []


def shown(page: Any) -> str:
    return page.locator("#scene-1 .tag.left").inner_text()


def test_clicking_a_name_switches_the_image(page: Any):
    assert shown(page) == "reference"
    page.locator("#scene-1 .tools [data-show='3']").click()
    assert shown(page) == "better"
    visible = page.locator("#scene-1 .plane > img:visible")
    assert visible.count() == 1
    assert visible.get_attribute("alt") == "better"
    assert visible.evaluate("image => image.naturalWidth") == 96
    page.locator("#scene-1 .tools [data-show='2']").click()
    assert shown(page) == HOSTILE


def test_keys_switch_images_and_layers_of_the_viewer_in_use(page: Any):
    page.keyboard.press("2")
    assert shown(page) == "reference", "keys belong to the page until a viewer is in use"
    page.locator("#scene-1 .stage").focus()
    for key, expected in [
        ("2", "path"), ("4", "better"), ("9", "better"), ("ArrowRight", "reference"),
        ("ArrowLeft", "better"), ("e", "Errors of better"), ("2", "Errors of path"),
        ("1", "reference"), ("2", "Errors of path"), ("e", "path"),
    ]:
        page.keyboard.press(key)
        assert shown(page) == expected
    assert page.locator("#scene-2 .tag.left").inner_text() == "reference"


def test_divider_moves_by_mouse_and_keys(page: Any):
    stage, divider = (page.locator(f"#scene-1 .{name}") for name in ("stage", "divider"))
    assert divider.is_hidden()
    page.locator("#scene-1 [data-other]").select_option(label="better")
    assert page.locator("#scene-1 .tag.right").inner_text() == "better"
    stage.scroll_into_view_if_needed()
    box = stage.bounding_box()
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, middle)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 4, middle)
    page.mouse.up()
    assert divider.get_attribute("aria-valuenow") == "25"
    divider.focus()
    page.keyboard.press("ArrowRight")
    assert divider.get_attribute("aria-valuenow") == "27"
    assert shown(page) == "reference", "the arrows move the divider, not the flip-book"
    clip = page.locator("#scene-1 .plane > img[alt=better]").evaluate("i => i.style.clipPath")
    assert "inset" in clip


def test_wheel_buttons_and_keys_zoom_and_dragging_moves(page: Any):
    stage, plane = (page.locator(f"#scene-1 .{name}") for name in ("stage", "plane"))
    stage.scroll_into_view_if_needed()
    outer = stage.bounding_box()
    x, y = outer["x"] + outer["width"] / 4, outer["y"] + outer["height"] / 4
    page.mouse.move(x, y)
    boxes = [plane.bounding_box()]
    for _ in range(4):
        page.mouse.wheel(0, -100)
        page.wait_for_function(
            "width => document.querySelector('#scene-1 .plane').offsetWidth > width + 1",
            arg=boxes[-1]["width"],
        )
        boxes.append(plane.bounding_box())
    fit, before, zoomed = boxes[0], boxes[-2], boxes[-1]
    # What was below the pointer still is (now that the image fills the stage)
    assert (x - zoomed["x"]) / zoomed["width"] == pytest.approx(
        (x - before["x"]) / before["width"], abs=1e-3
    )
    page.mouse.down()
    page.mouse.move(x - 20, y - 10)
    page.mouse.up()
    moved = plane.bounding_box()
    assert (moved["x"], moved["y"]) == pytest.approx(
        (zoomed["x"] - 20, zoomed["y"] - 10), abs=0.1
    )
    page.keyboard.press("0")
    assert plane.bounding_box() == pytest.approx(fit, abs=0.1)
    page.locator("#scene-1 [data-zoom=in]").click()
    assert plane.bounding_box()["width"] > fit["width"]
    image = page.locator("#scene-1 .plane > img:visible")
    assert image.evaluate("i => getComputedStyle(i).imageRendering") == "pixelated"


def test_windows_and_overview_lead_to_the_viewer(page: Any):
    page.locator("#scene-1 .crops [data-show='3']").first.click()
    assert shown(page) == "better"
    assert page.locator("#scene-1 .zoomed").count() == 1
    assert page.locator("#scene-1 .plane .window").count() == 3
    page.locator("#scene-1 [data-marks]").uncheck()
    assert page.locator("#scene-1 .plane .window:visible").count() == 0
    page.locator("#scene-1 [data-open=error]").first.click()
    assert shown(page) == "Errors of path"


@pytest.mark.parametrize("width", [1600, 1280, 400])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_page_fits_its_width_and_every_image_is_there(page: Any, width: int, scheme: str):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 800})
    page.evaluate("for (const image of document.images) image.loading = 'eager'")
    page.wait_for_function("[...document.images].every(image => image.naturalWidth > 0)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (background == "rgb(255, 255, 255)") == (scheme == "light")


def test_controls_have_names(page: Any):
    for control in page.locator("button, select, input, [tabindex]").all():
        named = control.evaluate(
            "e => Boolean(e.ariaLabel || e.innerText.trim() || e.labels?.length)"
        )
        assert named, control.evaluate("e => e.outerHTML.slice(0, 80)")
