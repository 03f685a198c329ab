"""``mitsuba-ext export-blender``: the table has what the code of the add-on mitsuba-blender reads.

The checks follow ``create_plugin_props`` and ``MitsubaRenderSettings`` in the add-on's
``engine/properties.py`` (commit 862d44f). Blender itself is not run.
"""

from __future__ import annotations

import json
from typing import Any

import mitsuba as mi
import pytest

from mitsuba_ext.cli.export_blender import blender_table
from mitsuba_ext.startup import pages, plugin_folders

pytestmark = pytest.mark.usefixtures("variant")

TABLE = blender_table()

#: What a group of properties has already: Blender's members, and those that the add-on adds.
TAKEN = {"name", "bl_rna", "rna_type", "id_data", "args", "draw", "to_dict"}

#: The add-on's longest prefix of a class: integrators that it nests in each other, three deep.
PREFIX = "Stokes" * 3


@pytest.mark.parametrize("name", TABLE)
def test_an_entry_has_the_data_of_the_menus(name: str) -> None:
    entry = TABLE[name]
    assert set(entry) == {"label", "description", "parameters"}
    assert entry["label"] and entry["description"] and f"({name})" not in entry["label"]
    assert f"{name.title()}Props".isidentifier()
    assert len(f"{PREFIX}{name.title()}Props") < 64, "Blender refuses longer names of classes"
    for key, parameter in entry["parameters"].items():
        assert key.isidentifier() and key not in TAKEN
        assert isinstance(parameter["label"], str) and isinstance(parameter["description"], str)
        default = parameter["default"]
        # Blender's property of each type, and the value that it takes
        expected = {"integer": int, "float": float, "boolean": bool}[parameter["type"]]
        assert type(default) is expected
        if expected is int:
            assert -(2**31) <= parameter["min"] <= default < 2**31


@pytest.mark.parametrize("name", TABLE)
def test_integrator_loads_with_all_parameters_that_the_add_on_writes(name: str) -> None:
    """It writes defaults too: no parameter may be refused where it has no effect."""
    mi.load_dict({"type": name, **_values(TABLE[name])})


def _values(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: parameter["default"] for key, parameter in entry["parameters"].items()}


def test_every_integrator_that_nests_none_is_in_the_table() -> None:
    left_out = {path.stem for path in plugin_folders.plugin_files("integrators")} - set(TABLE)
    nesting = {
        path.stem for path in plugin_folders.plugin_files("integrators")
        if any(row.type == "integrator" for row in pages.read_page(path).parameters)
    }
    assert left_out == nesting | {"composed_prb"}
    for name in ("auto", "bdpt", "vcm"):
        assert {"max_depth", "hide_emitters", "timeout"} <= set(TABLE[name]["parameters"])


def test_printed_table_begins_with_the_add_on_s_default(run) -> None:
    code, out, err = run("export-blender")
    table = json.loads(out)
    assert (code, err) == (0, "") and list(table)[0] == "path"
    assert set(table) == {"path", *TABLE}
    assert _values(table["path"]) == {"max_depth": -1, "rr_depth": 5, "hide_emitters": False}


def test_other_integrators_of_an_existing_table_stay(run, tmp_path) -> None:
    file = tmp_path / "integrators.json"
    theirs = {
        "path": {"label": "Theirs", "description": "", "parameters": {}},
        "stokes": {"label": "S", "description": "", "parameters": {"i": {"type": "integrator"}}},
        "bdpt": {"label": "An older one of ours", "description": "", "parameters": {}},
    }
    file.write_text(json.dumps(theirs))
    assert run("export-blender", "-o", file)[0] == 0
    first = file.read_text()
    table = json.loads(first)
    assert (table["path"], table["stokes"]) == (theirs["path"], theirs["stokes"])
    assert {name: table[name] for name in TABLE} == TABLE
    assert run("export-blender", "-o", file)[0] == 0 and file.read_text() == first


@pytest.mark.parametrize("content", ["{", "[]", '{"path": 1}'])
def test_file_that_is_no_table_is_refused_and_kept(run, tmp_path, content: str) -> None:
    file = tmp_path / "integrators.json"
    file.write_text(content)
    code, out, err = run("export-blender", "-o", file)
    assert (code, out) == (2, "") and str(file) in err and err.count("\n") == 1
    assert file.read_text() == content
