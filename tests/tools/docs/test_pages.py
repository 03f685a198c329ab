"""The pages of plugins are true, and describe nothing twice."""

from __future__ import annotations

import re
from fractions import Fraction

import pytest

from mitsuba_ext.bases.slots import SLOTS
from mitsuba_ext.inputs.specifications import make_named
from mitsuba_ext.startup import pages, plugin_folders
from tests.support.paths import ROOT

import mitsuba as mi  # isort: skip

pytestmark = pytest.mark.usefixtures("variant")

FOLDERS = plugin_folders.plugin_names()
FILES = {file.stem: file for folder in FOLDERS for file in plugin_folders.plugin_files(folder)}
README = ROOT / "README.md"
CHOICES = ROOT / "docs" / "choose.md"
DECISIONS = plugin_folders.decision_names()
#: The samplers of sensors.
SEQUENCES = sorted(set(FOLDERS["samplers"]) - set(DECISIONS))
#: The integrators that nest no other one.
WALKS = [
    "auto_path", "composed_path", "erpt", "instant_radiosity", "irradiance_cache", "mlt", "neepp",
    "photon_map", "pss_guided", "pssmlt", "reweighted_direct", "sppm", "two_stage",
]

#: A value that each parameter accepts, besides the words that its row begins with.
VALUES = {
    "roulette": "throughput", "save_learned": "learned.npz", "load_learned": "learned.npz",
    **dict.fromkeys(["max_depth", "rr_depth", "grid", "pilot_spp", "refine", "tile", "bounces"], 3),
    **dict.fromkeys(["connections", "count", "light_samples", "camera_samples", "learn_every"], 3),
    "boxes": 16, "candidates": 4, "splits": 7, "share": 0.5,
    **dict.fromkeys(["hide_emitters", "rejection", "always_guide", "always_use"], True),
    "nee_first_bounce": True,
    "keep_learned": True,
    **dict.fromkeys(["timeout", "max_memory", "slope"], 8.0), "floor": 0.5,
    "aovs": "d:depth", "regions": "surfaces",
    "directions": "guided", "next_event": "power", "shadow_test": "visibility_roulette",
    "flights": "transmittance",
    "aperture": "sobol", "time": "sobol", "wavelength": "sampler", "distance": "swarm",
    "light_numbers": "swarm", "scattering": "swarm", "caustics": "manifold",
    "pattern": "sobol",
    "weights": "torus", "vertices": "all", "law": "affine", "target": "visibility",
    "light_sampling": "visibility", "mis": "balance", "heuristic": "cutoff", "exponent": 3.0,
    "threshold": 0.2, "visibility": "primary", "reallocated": 0.5, "gradient_samples": "loss",
    **dict.fromkeys(["bidirectional", "kelemen_style_weights", "two_stage", "blue_noise"], True),
    **dict.fromkeys(["chains", "chain_length", "direct_samples", "luminance_samples"], 3),
    **dict.fromkeys(["mutations_per_pixel", "most_consecutive", "proposal_filter"], 3),
    **dict.fromkeys(["sample_count", "seed", "dimensions", "film_width"], 6),
    "radius": 0.5, "radius_in_media": 0.5, "radius_decay": 0.5, "merging": "all",
    "light_paths": 0.5, ("instant_radiosity", "light_paths"): 16, "interleaving": 2,
    "choice": "clustered", "bound": 2.0, "compensation": False,
    **dict.fromkeys(["photons", "lookup_size"], 16), "global_radius": 0.5, "caustic_radius": 0.5,
    **dict.fromkeys(["final_gather", "guided", "photon_aovs", "light_aovs"], True),
    **dict.fromkeys(["clamp_direct", "clamp_indirect"], 2.0),
    "accuracy": 0.25, "max_share": 0.5, "effort": 2.0, "gather_samples": 64,
    "cache_file": "cache.npz", "min_spacing": 3.0, "max_spacing": 8.0,
    "checkpoint": "kept", "checkpoint_every": "9s",
    "chain_file": "chains.npz", "mutations": "path", "outliers": 2.0, "p_large": 0.5,
    **dict.fromkeys(["bidirectional_mutation", "lens_perturbation"], True),
    **dict.fromkeys(["multi_chain_perturbation", "caustic_perturbation"], True),
}  # fmt: skip

#: What makes a parameter known that is not always.
CONDITIONS = {
    **{(name, key): {"next_event": "contribution"} for name in ("composed_path", "composed_prb")
       for key in ("pilot_spp", "save_learned", "load_learned", "keep_learned", "learn_every")},
    **{("two_stage", key): {"visibility": "primary"}
       for key in ("reallocated", "pilot_spp", "save_learned", "load_learned", "keep_learned")},
    **{("instant_radiosity", key): {"choice": "learned"}
       for key in ("pilot_spp", "save_learned", "load_learned", "keep_learned")},
    ("two_stage_lights", "reallocated"): {"visibility": "world"},
    ("pss_guided", "tile"): {"regions": "tiles"},
    ("guided_directions", "tile"): {"regions": "tiles"},
    **{("neepp", key): {"rejection": True} for key in ("law", "slope", "floor")},
    ("mis_heuristic", "threshold"): {"heuristic": "cutoff"},
    **{("erpt", f"{kind}_perturbation"): {"mutations": "path"}
       for kind in ("lens", "multi_chain", "caustic")},
    ("erpt", "bidirectional_mutation"): {"mutations": "path"},
    ("neepp", "refine"): {"rejection": True, "light_sampling": "uniform"},
}


#: Of all integrators of ours.
CHECKPOINT = {"checkpoint_every": {"checkpoint": "kept"}}


def make(name: str, **values: object) -> tuple[mi.Object, list[str]]:
    """A plugin, and the names of the parameters that it does not know."""
    properties = mi.Properties(name)
    for key, value in values.items():
        properties[key] = value
    return mi.PluginManager.instance().create_object(properties), properties.unqueried()


def described(name: str) -> dict[str, str]:
    """The parameters on a page and their defaults."""
    rows = pages.read_page(FILES[name]).parameters
    return {key: row.default for row in rows for key in row.name.split(", ")}


def test_row_of_common_parameters_stands_for_the_table_of_the_base_class(tmp_path):
    row = "     * - {0}\n       - |int|\n       - {1}. (Default: 1)\n"
    table = "\n    .. pluginparameters::\n\n"
    common = "     * - (Common parameters)\n       - |several|\n       - Those of the base.\n"
    (tmp_path / "deeper").mkdir()
    (tmp_path / "root.py").write_text(
        f'class Root:\n    """Root.\n{table}{row.format("e", "Root e")}    """\n'
    )
    (tmp_path / "deeper" / "base.py").write_text(
        f'from ..root import Root\n\nclass Other:\n    pass\n\nclass Base(Root):\n    """Base.\n'
        f'{table}{row.format("b", "Base b")}{common}{row.format("c", "Base c")}    """\n'
    )
    plugin = tmp_path / "plugin.py"
    plugin.write_text(
        f'from .deeper.base import Base\nfrom x import y\nraise SystemExit\n\n@y\nclass P(Base):\n'
        f'    """P.\n{table}{row.format("a", "Own a")}{common}{row.format("c", "Own c")}    """\n'
    )
    parameters = pages.read_page(plugin).parameters
    assert [(row.name, row.description) for row in parameters] == [
        ("a", "Own a."), ("b", "Base b."), ("e", "Root e."), ("c", "Own c."),
    ]
    # Classes between that have no table are passed over, in the same file too
    plugin.write_text(
        f'from .deeper.base import Base\n\nclass Between(Base):\n    pass\n\n'
        f'class P(Between):\n    """P.\n{table}{common}    """\n'
    )
    assert [row.name for row in pages.read_page(plugin).parameters] == ["b", "e", "c"]
    plugin.write_text(f'class P(Base):\n    """P.\n{table}{common}    """\n')
    with pytest.raises(ValueError, match="P has no base class with"):
        pages.read_page(plugin)


@pytest.mark.parametrize("name", [*WALKS, "auto", "bdpt", "light_tracer", "vcm"])
def test_integrators_describe_the_common_parameters_by_reference(name):
    own = {row.name: row for row in pages.read_page(FILES[name]).parameters}
    shared = {row.name: row for row in pages.read_page(FILES["composed_path"]).parameters}
    for key in ("max_depth", "rr_depth", "hide_emitters", "timeout", "aovs"):
        assert own[key] == shared[key]
        assert f"* - {key}\n" not in FILES[name].read_text()


@pytest.mark.parametrize("name", FILES)
def test_pages_have_the_sections_of_a_manual(name):
    page, text = pages.read_page(FILES[name]), FILES[name].read_text()
    prose = " ".join(page.text.split())
    assert page.title.endswith(f"({name})") and f"-{name}:\n" in text and page.parameters
    for words in ("Use it when", "Not when", "Source", "'type': '", ' type="'):
        assert words in prose
    for row in page.parameters:
        assert row.type and len(row.description) > 10, row
    if name in DECISIONS:
        assert "composed_path" in page.summary and "--integrator" in page.text


@pytest.mark.parametrize("name", [*WALKS, "composed_prb", *DECISIONS, *SEQUENCES])
def test_every_parameter_of_a_page_is_known(name):
    for key in described(name):
        condition = CONDITIONS.get((name, key), CHECKPOINT.get(key, {}))
        _, unknown = make(name, **{key: VALUES.get((name, key), VALUES.get(key)), **condition})
        assert not unknown


@pytest.mark.parametrize("name", [*WALKS, "composed_prb", *DECISIONS, *SEQUENCES])
def test_the_page_has_each_parameter_of_str_with_the_same_default(name):
    text = str(make(name)[0])
    assert text.startswith(f"{name}[\n")
    on_page = described(name)
    for key, value in re.findall(r"^  (\w+) = (.*?),?$", text, re.MULTILINE):
        if key in SLOTS and not name.startswith("composed_"):  # several parameters
            continue
        if key == "learns_from":  # a remark
            continue
        default = on_page[key].partition(";")[0].partition(" ")[0]
        if re.fullmatch(r"\d+/\d+", default):
            assert float(value) == Fraction(default)
        elif value != "automatic":
            assert {value.lower(), value.removesuffix(".0")} & {default, default.rstrip(",")}


def test_str_of_an_integrator_calls_decisions_as_a_scene_does():
    text = str(make_named("composed_path:directions=guided,next_event=contribution").integrator)
    assert "directions = guided_directions[regions = surfaces, bounces = 6," in text
    # Parameters without a value are left out, and those that the scene leaves to us say so
    assert "next_event = learned_lights[target = contribution, grid = automatic," in text
    assert "map" not in text and "learned_lights[grid = 0" not in text
    assert "next_event = power\n" in str(make_named("neepp:light_sampling=power").integrator)
    spatial = make_named("composed_path:next_event=[spatial_lights:grid=8]").integrator
    assert "spatial_lights[grid = 8," in str(spatial)


@pytest.mark.parametrize("name", ["composed_path", *DECISIONS])
def test_examples_are_the_same_as_xml_as_a_dict_and_on_the_command_line(name):
    text = pages.read_page(FILES[name]).text
    (xml,) = re.findall(r"<integrator.*</integrator>", text, re.DOTALL)
    (values,) = re.findall(r"^ *('type'.*?\n *\}.*?)\n\n", text, re.DOTALL | re.MULTILINE)
    (line,) = re.findall(r'"(composed_path:.*)"', text)
    scene = mi.load_string(f'<scene version="3.0.0">{xml}</scene>')
    shown = {str(scene.integrator()), str(mi.load_dict(eval(f"{{{values}}}")))}
    assert {*shown, str(make_named(line).integrator)} == shown and len(shown) == 1
    assert name in shown.pop()


@pytest.mark.parametrize("name", SEQUENCES)
def test_examples_of_samplers_are_the_same_as_xml_and_as_a_dict(name):
    text = pages.read_page(FILES[name]).text
    (xml,) = re.findall(r"<sampler.*</sampler>", text, re.DOTALL)
    (values,) = re.findall(r"^ *('type'.*)", text, re.DOTALL | re.MULTILINE)
    sensor = mi.load_string(f'<sensor version="3.0.0" type="perspective">{xml}</sensor>')
    assert str(sensor.sampler()) == str(mi.load_dict(eval(f"{{{values}}}")))


def test_example_of_the_readme_loads():
    (xml,) = re.findall(r"```xml\n(.*?)```", README.read_text(), re.DOTALL)
    assert "bounces = 4" in str(mi.load_string(f'<scene version="3.0.0">{xml}</scene>'))


def test_every_integrator_and_decision_is_on_the_page_of_choices():
    page = CHOICES.read_text()
    for name in re.findall(r"\]\(../(?:integrators|samplers)/(\w+)\.py\)", page):
        assert name in FILES
    assert all(f"/{name}.py" in page for name in FILES)


def test_a_decision_cannot_be_the_sampler_of_a_sensor():
    sampler = mi.load_dict({"type": "guided_directions"})
    with pytest.raises(RuntimeError, match='nest it in a "composed_path", as "directions"'):
        sampler.next_1d()
