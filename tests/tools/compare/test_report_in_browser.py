"""The report of a comparison in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import chromium
from tests.support.report_data import HOSTILE, write_full


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_full(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


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
