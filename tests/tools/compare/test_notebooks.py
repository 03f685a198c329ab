"""Notebooks show statistics and comparisons as short tables, in which all text is escaped."""

from __future__ import annotations

import json
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext import compare
from mitsuba_ext.compare.notebook import Results
from mitsuba_ext.compare.report.summary import thumbnail
from tests.support.report_data import HOSTILE, make_results
from tests.support.report_data import make_scene as stored_scene

pytestmark = pytest.mark.usefixtures("variant")


def _cells(html: str) -> dict[str, str]:
    return dict(re.findall(r"<tr><th>(.*?)</th><td>(.*?)</td></tr>", html))


def test_statistics_of_a_render_are_a_table() -> None:
    scene = mi.load_dict({**mi.cornell_box(), "integrator": {"type": "neepp", "max_depth": 3}})
    mi.render(scene, sensor=_small(), spp=16)
    statistics = scene.integrator().statistics
    cells = _cells(statistics._repr_html_())
    assert cells["samples per pixel"].startswith("16 in ")
    assert cells["seconds"].startswith(f"{statistics.seconds:.2f} (learning ")
    assert f"camera {8 * 8 * 16:,}" in cells["rays"]
    assert cells["learned"] and set(statistics.effects) <= set(cells)
    assert repr(statistics).startswith("RenderStatistics(passes=")


def _small() -> mi.Sensor:
    return mi.load_dict(
        {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    )


def test_statistics_are_escaped_and_say_what_was_not_kept() -> None:
    from mitsuba_ext.rendering.statistics import RenderStatistics

    statistics = RenderStatistics(
        passes=1, spp=4, learned=HOSTILE, interrupted=True,
        effects={"directions": {"is_kept": False, "variance": 1.25}},
    )  # fmt: skip
    html = statistics._repr_html_()
    assert "<script" not in html and "&lt;script&gt;" in html
    cells = _cells(html)
    assert cells["samples per pixel"] == "4 in 1 pass, interrupted"
    assert (cells["seconds"], cells["rays"]) == ("0.00", "0")
    assert cells["directions"] == "not kept (variance 1.25 x)"


@pytest.fixture
def results(tmp_path: Path) -> Results:
    scene = stored_scene(tmp_path, "large", (320, 64), [4, 16], ["path", HOSTILE])
    scene["warnings"] = [HOSTILE]
    return Results(make_results([scene], "sweep", [4, 16]), tmp_path)


def test_comparison_is_a_table_with_small_pictures(results: Results) -> None:
    html = results._repr_html_()
    for text in ("large</strong>, 16 samples per pixel", ">efficiency<", ">relMSE<", ">time<"):
        assert text in html
    assert ">σ/μ<" not in html and "<script" not in html and html.count("&lt;script&gt;") >= 2
    images = re.findall(r'src="(data:image/jpeg;base64,[^"]+)"', html)
    assert len(images) == 2 and all(len(image) <= 50_000 for image in images)
    assert html.count("<tr>") == 3


def test_comparison_without_its_images_is_a_table(results: Results, tmp_path: Path) -> None:
    for file in tmp_path.rglob("*.exr"):
        file.unlink()
    html = results._repr_html_()
    assert "<img" not in html and html.count("<tr>") == 3


def test_failed_integrators_and_scenes_are_named(results: Results) -> None:
    results["state"] = "interrupted"
    broken = results["scenes"][0]["integrators"][1]
    broken.update(error="no light", levels=[], runs=[])
    results["scenes"].append({
        **results["scenes"][0], "name": "lost", "error": "no such file", "integrators": [],
        "reference": None,
    })  # fmt: skip
    html = results._repr_html_()
    for text in ("Interrupted", "failed: no light", ">failed<", "not measured: no such file"):
        assert text in html
    assert "Nothing was measured" in Results(make_results([], "spp", [4]), Path())._repr_html_()


def test_results_are_still_a_dict(results: Results) -> None:
    assert json.loads(json.dumps(results)) == results == dict(results)
    assert repr(results) == repr(dict(results))


def test_pictures_of_pure_noise_stay_small() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200, 3), dtype=np.uint8)
    assert len(thumbnail(noise)) <= 50_000
    assert len(thumbnail(noise[:120, :160])) <= 50_000


def test_measured_comparison_shows_its_tables(make_scene, tmp_path: Path) -> None:
    comparison = compare.Comparison(
        make_scene(), ["path"], compare.equal_samples(4), seeds=2, folder=tmp_path / "out",
        reference_spp=64,
    )  # fmt: skip
    assert comparison._repr_html_() is None
    html = comparison.run(progress=False)._repr_html_()
    assert "<img" in html and html == comparison._repr_html_()
