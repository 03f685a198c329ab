"""The results of a comparison on the terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from mitsuba_ext.compare import show, tables
from tests.support.report_data import make_results, make_scene

LABEL = "variance:nested=[neepp:max_depth=8,aovs=d:depth,a:albedo],batches=4"
HEADINGS = ["relMSE", "trimmed", "σ/μ", "FLIP", "spp", "seconds", "shadow", "eff.", "slope"]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    scene = make_scene(tmp_path_factory.mktemp("tables"), "one", (8, 6), [4, 16], ["path", LABEL])
    failed = dict(scene["integrators"][0], label="failed", error="no light", runs=[], levels=[])
    scene["integrators"].append(failed)
    return make_results([scene], "until", [0.01])


@pytest.mark.parametrize("width", [50, 60, 80, 120, 160, 250])
def test_all_columns_are_shown_at_every_width(results, width):
    text = io.StringIO()
    console = Console(file=text, width=width)
    for part in tables.tables(results, width):
        console.print(part, highlight=False, soft_wrap=not hasattr(part, "columns"))
    lines = text.getvalue().splitlines()
    heads = [line.split()[1:] for line in lines if line.startswith("integrator")]
    assert sum(heads, []) == [*HEADINGS, "s", "to", "target"]
    assert "…" not in text.getvalue()
    rows = [line for line in lines if line.startswith(("path", "integrator", "─", "failed "))]
    assert max(map(len, rows)) <= width
    assert text.getvalue().count("0.0625 ±10%") == 3  # relMSE, trimmed, σ/μ of path
    assert lines[0].startswith("/scenes/one.xml, 8x6") and "failed: no light" in lines


def test_labels_are_broken_where_their_parts_begin(results):
    text = io.StringIO()
    Console(file=text, width=75).print(*tables.tables(results, 75))
    before, _, after = text.getvalue().partition("variance")
    label = after.split("failed")[0].splitlines()
    assert [line.split()[0] for line in label] == [
        ":nested=[", "neepp:max_depth=8,", "aovs=d:depth,a:albedo],", "batches=4",
    ]


def test_pipes_get_one_table(results, capsys):
    show(results)
    out = capsys.readouterr().out
    assert out.count("integrator ") == 1 and max(map(len, out.splitlines()[:8])) <= 160
