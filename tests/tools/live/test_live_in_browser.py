"""The page of a running render in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from mitsuba_ext.live.server import WebReceiver
from mitsuba_ext.live.snapshot import Snapshot
from mitsuba_ext.live.viewer import FINISHED, PAUSED, RENDERING, STOPPING, Viewer
from tests.support.browser import chromium

HOSTILE = '<img src=x onerror="alert(1)">'


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


class Live:
    """A viewer with a page."""

    def __init__(self) -> None:
        self.web = WebReceiver(0)
        self.viewer = Viewer([self.web])
        self.web.serve(self.viewer, True)
        facts = {"title": "image.exr", "Scene": HOSTILE, "Integrator": "neepp (max_depth 8)"}
        self.viewer.begin("scene", facts)

    def show(self, spp: int, image: np.ndarray | None = None, name: str = "scene") -> None:
        if image is None:
            image = np.full((20, 30, 3), 0.25)
        image = image.astype(np.float32)
        self.viewer.present(lambda: Snapshot(
            image, ("R", "G", "B"), 3, spp, 0.5 * spp, np.full_like(image, 1 / spp), 1 / spp,
            f"learned {HOSTILE}", {"next_event": {"is_kept": True, "variance": 0.7}},
        ), name)  # fmt: skip
        self.viewer.tell(spp=spp, goal_spp=64, seconds=0.5 * spp, done=spp / 64)


@pytest.fixture
def live() -> Iterator[Live]:
    live = Live()
    yield live
    live.web.state._pages.clear()  # they are closed
    live.viewer.close()


@pytest.fixture
def page(browser: Any, live: Live) -> Iterator[Any]:
    """The page of a render with 8 samples; complaints of any kind fail the test."""
    live.show(4)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(30000)
    complaints: list[str] = []
    # The tests read the canvas more often than the page does
    page.on("console", lambda message: complaints.append(message.text)
            if "getImageData" not in message.text else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: (complaints.append(dialog.message), dialog.dismiss()))
    page.goto(live.web.address)
    shows(page, "4 of 64 per pixel")
    live.show(8)
    shows(page, "8 of 64 per pixel")
    until(page, "canvas.width === 30")
    yield page
    page.close()
    assert complaints == []


def until(page: Any, condition: str, argument: Any = None) -> None:
    """Waits for a condition, which the page's policy lets only the browser itself evaluate."""
    for _ in range(1500):
        if page.evaluate(condition, argument):
            return
        page.wait_for_timeout(20)
    pytest.fail(f"{condition} ({argument}): {page.locator('body').inner_text()}")


def shows(page: Any, text: str) -> None:
    until(page, "text => document.body.innerText.includes(text)", text)


def pixel(page: Any, x: int = 3, y: int = 2) -> list[int]:
    code = f"[...canvas.getContext('2d').getImageData({x}, {y}, 1, 1).data]"
    return page.evaluate(code)


def test_figures_and_the_curve_follow_the_render(page: Any, live: Live):
    assert page.title() == "12 % image.exr"
    shows(page, "about 0.125")
    for text in ("rendering", "4.0 s", "30×20 pixels", "kept, variance 0.70 ×", HOSTILE):
        shows(page, text)
    points = page.locator("#chart polyline").get_attribute("points")
    assert len(points.split()) == 2
    for spp in (16, 32):
        live.show(spp)
        shows(page, f"{spp} of 64 per pixel")
    until(page, "document.querySelector('.curve').points.length === 4")


@pytest.mark.slow
def test_exposure_and_pixels_are_those_of_the_linear_image(page: Any, live: Live):
    assert pixel(page) == [137, 137, 137, 255]  # 0.25 in sRGB
    page.locator("#exposure").fill("1")
    assert pixel(page) == [188, 188, 188, 255]  # 0.5
    page.locator("#auto").click()
    assert pixel(page)[0] == pytest.approx(231, abs=4)  # 0.8, up to a tenth of a stop
    page.locator("#reset").click()
    assert pixel(page) == [137, 137, 137, 255]
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    shows(page, "(15, 10): 0.25, 0.25, 0.25")
    image = np.full((20, 30, 3), 0.25)
    image[2, 3, 1], image[2, 4, 1], image[2, 5] = np.nan, np.inf, 1e9
    live.show(16, image)
    shows(page, "2 pixels are NaN or infinite")
    until(page, "canvas.getContext('2d').getImageData(3, 2, 1, 1).data[1] === 0")
    assert [pixel(page, x) for x in (3, 4, 5)] == [
        [255, 0, 200, 255], [255, 0, 200, 255], [255, 255, 255, 255]
    ]  # fmt: skip


@pytest.mark.slow
def test_the_noise_of_each_pixel_is_a_layer(page: Any):
    page.locator("[data-layer=error]").click()
    shows(page, "% of the brightness")
    assert page.locator("#exposure").is_hidden()
    until(page, "canvas.getContext('2d').getImageData(3, 2, 1, 1).data[0] > 240")


@pytest.mark.slow
def test_several_images_have_names(page: Any, live: Live):
    live.show(8, np.zeros((10, 10, 3)), HOSTILE)
    until(page, "document.querySelector('#picture').options.length === 2")
    page.locator("#picture").select_option(HOSTILE)
    until(page, "canvas.width === 10")
    assert pixel(page) == [0, 0, 0, 255]


def test_buttons_pause_and_stop_the_render(page: Any, live: Live, monkeypatch):
    ended: list[int] = []
    monkeypatch.setattr("mitsuba_ext.rendering.interrupts.request_end", lambda: ended.append(1))
    page.locator("#pause").click()
    shows(page, "Continue")
    assert live.viewer.phase == PAUSED
    page.locator("#pause").click()
    until(page, "document.querySelector('#pause').textContent === 'Pause'")
    assert live.viewer.phase == RENDERING
    page.locator("#stop").click()
    shows(page, "stopping after the running pass")
    assert (live.viewer.phase, ended) == (STOPPING, [1])
    assert page.locator("#stop").is_disabled()


@pytest.mark.slow
def test_without_the_key_the_page_has_no_buttons(page: Any, live: Live):
    page.goto("about:blank")
    page.goto(live.web.address.split("#")[0])
    shows(page, "8 of 64 per pixel")
    assert page.locator("#actions").is_hidden()


@pytest.mark.slow
def test_the_last_image_stays_when_the_render_has_ended(page: Any, live: Live):
    live.show(64, np.full((20, 30, 3), 1.0))
    live.viewer.close(FINISHED)  # waits for the page
    shows(page, "finished")
    assert pixel(page) == [255, 255, 255, 255]
    assert page.title() == "100 % image.exr"
    page.wait_for_timeout(1500)  # it no longer asks
    assert page.locator("#lost").is_hidden()


@pytest.mark.slow
def test_a_page_whose_render_is_gone_says_so(browser: Any, live: Live):
    """A killed process says nothing."""
    live.show(4)
    page = browser.new_page()
    page.goto(live.web.address)
    shows(page, "4 of 64 per pixel")
    live.web._server.shutdown()
    live.web._server.server_close()
    shows(page, "its process has ended")
    assert "no connection" in page.locator("#phase").inner_text()
    page.close()


@pytest.mark.slow
@pytest.mark.parametrize("width", [1400, 800, 360])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_its_width(page: Any, width: int, scheme: str):
    page.emulate_media(color_scheme=scheme)
    page.set_viewport_size({"width": width, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    background = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (background == "rgb(255, 255, 255)") == (scheme == "light")


@pytest.mark.slow
def test_controls_have_names(page: Any):
    for control in page.locator("button, select, input, progress, [tabindex]").all():
        named = control.evaluate(
            "e => Boolean(e.ariaLabel || e.innerText.trim() || e.labels?.length)"
        )
        assert named or control.is_hidden(), control.evaluate("e => e.outerHTML.slice(0, 80)")
