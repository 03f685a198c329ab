"""Snapshots in the viewer tev."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from mitsuba_ext.compare import read_exr
from mitsuba_ext.live.snapshot import Snapshot
from mitsuba_ext.live.viewer import open_viewer
from mitsuba_ext.util.errors import InputError
from tests.support.fake_tev import FakeTev


@pytest.fixture(autouse=True)
def client() -> None:
    pytest.importorskip("tevclient", reason="needs Python 3.11")


def snapshot(value: float = 1.0, size: tuple[int, int] = (150, 130), names="RGB") -> Snapshot:
    image = np.arange(size[0] * size[1], dtype=np.float32).reshape(*size, 1) * np.ones(len(names))
    return Snapshot(value * image, tuple(names), 3, 4)


def test_channels_and_variance_of_a_render_arrive_in_tev(run, make_scene, tmp_path):
    tev, output = FakeTev(), tmp_path / "a.exr"
    scene = make_scene(integrator='<integrator type="neepp"><string name="aovs" value="d:depth"/>'
                                  '</integrator>')
    code, _, err = run(
        "render", scene, "-o", output, "--spp", 64, "--checkpoint", tmp_path / "kept",
        "--tev", tev.address,
    )  # fmt: skip
    assert (code, "warning" in err) == (0, False)
    tev.wait_for(1)
    channels, _ = read_exr(output)
    assert tev.focused == ["scene"]
    found = tev.images["scene"]
    assert set(found) == set(channels)
    for name, plane in channels.items():
        np.testing.assert_allclose(found[name], plane, rtol=1e-5, err_msg=name)


def test_an_image_of_several_tiles_arrives_whole_and_does_not_take_the_focus_twice():
    tev, sent = FakeTev(), snapshot()
    viewer, _ = open_viewer(tev.address, None, False, pytest.fail)
    viewer.present(lambda: sent, "a")
    tev.wait_for(1)
    np.testing.assert_array_equal(tev.images["a"]["G"], sent.image[..., 1])
    viewer.present(lambda: snapshot(2.0), "a")
    tev.wait_for(2)
    np.testing.assert_array_equal(tev.images["a"]["G"], 2 * sent.image[..., 1])
    viewer.present(lambda: snapshot(size=(3, 2), names=("R", "G", "B", "7.é")), "a")
    tev.wait_for(3)
    assert list(tev.images["a"]) == ["R", "G", "B", "_7.?"]
    assert tev.focused == ["a"]
    viewer.close()


def test_a_tev_that_is_closed_and_opened_again_gets_the_next_snapshot():
    tev, said = FakeTev(), threading.Event()
    viewer, _ = open_viewer(tev.address, None, False, lambda text: said.set())
    viewer.present(snapshot, "a")
    tev.wait_for(1)
    tev.close()
    for _ in range(600):  # the system notices at the second write
        viewer.present(snapshot, "a")
        if said.wait(0.1):
            break
    assert said.is_set()
    tev = FakeTev(tev.port)
    viewer.present(snapshot, "a")
    tev.wait_for(1)
    assert tev.focused == ["a"]
    viewer.close()


def test_a_render_without_tev_ends_with_a_warning(run, make_scene, tmp_path):
    tev = FakeTev()
    tev.close()  # nobody listens there
    code, _, err = run(
        "render", make_scene(), "-o", tmp_path / "a.exr", f"--tev={tev.address}", "--quiet"
    )
    assert code == 0 and (tmp_path / "a.exr").exists()
    assert err.count("\n") == 1 and f"tev does not answer at {tev.address}" in err


def test_a_tev_that_hangs_does_not_hold_the_render(monkeypatch):
    monkeypatch.setattr("mitsuba_ext.live.viewer._LAST_SECONDS", 0.1)
    tev = FakeTev(reads=False)
    said: list[str] = []
    viewer, _ = open_viewer(tev.address, None, False, said.append)
    large = snapshot(size=(2000, 2000))
    for _ in range(3):
        viewer.present(lambda: large, "a")  # more than the system buffers
    viewer.close()
    assert any("not all snapshots" in text for text in said)


@pytest.mark.parametrize("before", [True, False])
def test_the_option_has_a_default_before_and_after_the_scene(
    run, make_scene, tmp_path, monkeypatch, before
):
    tev = FakeTev()
    monkeypatch.setattr("mitsuba_ext.cli.viewing.TEV", tev.address)
    arguments = ["--tev", make_scene()] if before else [make_scene(), "--tev"]
    assert run("render", "-o", tmp_path / "a.exr", *arguments)[0] == 0
    tev.wait_for(1)


@pytest.mark.parametrize("address", ["host:port", "a:b:1", "x:0", "x:99999"])
def test_a_wrong_address_is_refused_before_the_render(run, make_scene, tmp_path, address):
    code, _, err = run("render", make_scene(), "-o", tmp_path / "a.exr", f"--tev={address}")
    assert code == 2 and f'found "{address}"' in err and not (tmp_path / "a.exr").exists()


def test_a_missing_client_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tevclient", None)
    with pytest.raises(InputError, match=r'"tevclient" is missing: pip install .*\[view\]'):
        open_viewer("127.0.0.1:1", None, False, print)
