"""The server of the page: who may ask what."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from mitsuba_ext.live.preview import half_floats, reduced
from mitsuba_ext.live.server import WebReceiver
from mitsuba_ext.live.snapshot import Snapshot
from mitsuba_ext.live.viewer import FINISHED, PAUSED, RENDERING, STOPPING, Viewer


class Page:
    """Asks a server."""

    def __init__(self, has_control: bool) -> None:
        self.web = WebReceiver(0)
        self.viewer = Viewer([self.web])
        self.web.serve(self.viewer, has_control)
        address, _, self.key = self.web.address.partition("#")
        self.host = address.split("/")[2]

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection(self.host, timeout=30)
        connection.request(
            method, path, headers={key.replace("_", "-"): x for key, x in headers.items()}
        )
        answer = connection.getresponse()
        content = answer.read()
        assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
        connection.close()
        return answer.status, content

    def act(self, action: str, **headers: str) -> int:
        return self.ask(f"/{action}", "POST", **headers)[0]

    def state(self) -> dict:
        return json.loads(self.ask("/state")[1])


@pytest.fixture(params=[True], ids=["control"])
def page(request) -> Iterator[Page]:
    page = Page(request.param)
    yield page
    page.viewer.close()


def snapshot(image: np.ndarray, names: str = "RGB", **more) -> Snapshot:
    return Snapshot(image.astype(np.float32), tuple(names), len(names), 4, **more)


def test_only_this_machine_is_served(page):
    assert page.web._server.server_address[0] == "127.0.0.1"
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "x@localhost:1", ""):
        assert page.ask("/state", Host=host)[0] == 403, host
    # A tunnel leads to another port of the same name
    for host in ("localhost", "LOCALHOST:8000", "127.0.0.1:1", "[::1]:8000"):
        assert page.ask("/state", Host=host)[0] == 200, host


def test_only_pages_with_the_key_act(page, monkeypatch):
    ended = []
    monkeypatch.setattr("mitsuba_ext.rendering.interrupts.request_end", lambda: ended.append(1))
    key, origin = page.key, f"http://{page.host}"
    assert len(key) >= 20
    for headers in (
        {}, {"X_Mitsuba_Ext_Key": ""}, {"X_Mitsuba_Ext_Key": "wrong"},
        {"X_Mitsuba_Ext_Key": key, "Origin": "http://evil.example"},
        {"X_Mitsuba_Ext_Key": key, "Origin": "null"},
        {"X_Mitsuba_Ext_Key": key, "Host": "evil.example"},
    ):  # fmt: skip
        assert [page.act(name, **headers) for name in ("pause", "stop")] == [403, 403], headers
    assert page.viewer.phase == RENDERING and not ended
    assert page.act("pause", X_Mitsuba_Ext_Key=key, Origin=origin) == 200
    assert page.viewer.phase == PAUSED
    assert page.act("resume", X_Mitsuba_Ext_Key=key) == 200 and page.viewer.phase == RENDERING
    for _ in range(2):  # a second interrupt would discard the image
        assert page.act("stop", X_Mitsuba_Ext_Key=key) == 200
    assert page.viewer.phase == STOPPING and ended == [1]
    assert page.ask("/stop", X_Mitsuba_Ext_Key=key)[0] == 404, "a GET changes nothing"
    assert page.act("nothing", X_Mitsuba_Ext_Key=key) == 404


@pytest.mark.parametrize("page", [False], indirect=True, ids=["read-only"])
def test_a_page_without_control_only_looks(page):
    assert "#" not in page.web.address and page.state()["actions"] == []
    for name in ("pause", "resume", "stop"):
        assert page.act(name, X_Mitsuba_Ext_Key=page.web.key) == 404


def test_pixels_arrive_as_half_floats(page):
    image = np.array([[[0.5, 1e6, -1], [np.nan, np.inf, -np.inf]]])
    page.viewer.present(lambda: snapshot(image, variance=np.ones((1, 2, 3), np.float32)), "ä b")
    while not (pictures := page.state()["pictures"]):
        pass
    (picture,) = pictures
    assert (picture["size"], picture["film"], picture["bad"]) == ([2, 1], [2, 1], 1)
    status, content = page.ask("/image?name=%C3%A4%20b")
    found = np.frombuffer(content, "<f2").reshape(1, 2, 3)
    np.testing.assert_array_equal(found, [[[0.5, 65504, -1], [np.nan, np.inf, -np.inf]]])
    assert len(page.ask("/error?name=%C3%A4%20b")[1]) == 4
    for path in ("/image", "/image?name=other", "/favicon.ico", "/../etc/passwd"):
        assert page.ask(path)[0] == 404, path


def test_a_port_in_use_is_an_error_of_the_command(run, make_scene, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--serve", port)
    assert code == 2 and f"port {port} is in use: name another one" in err
    assert not (tmp_path / "a.exr").exists()


def test_control_needs_a_page(run, make_scene, tmp_path):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", "--control")
    assert code == 2 and "--control needs --serve" in err


def test_the_end_waits_only_for_pages_that_are_open(page, monkeypatch):
    waited = []
    monkeypatch.setattr("mitsuba_ext.live.server._LAST_SECONDS", 60)
    monkeypatch.setattr("mitsuba_ext.live.server.time.sleep", waited.append)
    state = page.web.state
    state.receive("a", snapshot(np.ones((1, 1, 3))))
    assert state.all_have_seen(FINISHED), "no page is open"
    page.ask("/state?page=one&number=0&phase=rendering")
    assert not state.all_have_seen(FINISHED)
    page.ask(f"/state?page=one&number=1&phase={FINISHED}")
    assert state.all_have_seen(FINISHED)
    page.ask("/state?page=two&number=x&phase=")
    monkeypatch.setattr("mitsuba_ext.live.web_state._GONE", -1)
    assert state.all_have_seen(FINISHED), "its page was closed"


def test_large_images_are_reduced_by_means(monkeypatch):
    monkeypatch.setattr("mitsuba_ext.live.preview._MOST_PIXELS", 20000)
    image = np.random.default_rng(0).random((230, 203, 3), dtype=np.float32)
    image[0, 0, 0] = np.nan
    small = reduced(image)
    assert small.shape == (115, 102, 3) and np.isnan(small[0, 0, 0])
    np.testing.assert_allclose(small[5, 7], image[10:12, 14:16].mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(small[5, -1], image[10:12, -1:].mean(axis=(0, 1)), rtol=1e-5)
    assert reduced(np.ones((1, 80000))).shape == (1, 40000)
    assert len(half_floats(small)) == 2 * small.size


@pytest.mark.parametrize(
    "names, values, expected",
    [
        ("RGBA", [1, 2, 3, 9], [1, 2, 3]), ("YA", [1, 9], [1, 1, 1]),
        ("XYZ", [0.9505, 1, 1.0891], [1, 1, 1]), ("abcde", [1, 2, 3, 4, 5], [3, 3, 3]),
    ],
)  # fmt: skip
def test_films_of_all_kinds_have_colours(names, values, expected):
    image = np.array(values) * np.ones((2, 2, 1))
    np.testing.assert_allclose(snapshot(image, names).rgb()[1, 1], expected, atol=1e-3)
