"""Plugins exist in each variant, whether it is selected before the import or after it."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

import mitsuba as mi
import pytest

from mitsuba_ext.startup import plugin_folders, runtime
from tests.support.paths import ROOT

LLVM_VARIANTS = [name for name in runtime.SUPPORTED_VARIANTS if name.startswith("llvm")]

#: Kernels that compile quickly
QUICK = "import tests.support.quick_kernels"

#: Some integrators have no depth of their own: they nest another one.
LOAD_ALL = """
WRAPPERS = (
    "adaptive", "control_variate", "ecoc_dof", "variance", "reweighted_lens", "reweighted_time",
    "reweighted_wavelength",
)

def load_all():
    from mitsuba_ext.startup import plugin_folders, registry
    for name in plugin_folders.plugin_names()["integrators"]:
        if name == "reweighted_wavelength" and not mi.is_spectral:
            continue
        if name in WRAPPERS:
            integrator = mi.load_dict({"type": name, "nested": {"type": "path", "max_depth": 3}})
        else:
            integrator = mi.load_dict({"type": name, "max_depth": 3})
            assert isinstance(integrator, (mi.SamplingIntegrator, mi.CppADIntegrator)), name
            assert integrator.max_depth == 3
        text = str(integrator)
        assert text.startswith(name) and "max_depth = 3" in text, text
"""


def _run(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", LOAD_ALL + code], cwd=ROOT, capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_an_integrator_works_in_a_variant_that_is_selected_again() -> None:
    _run(QUICK + """
import mitsuba_ext, drjit as dr, mitsuba as mi
for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
    mi.set_variant(variant)
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "ball": {"type": "sphere"},
        "camera": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(
            [0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 2, "height": 2}}})
    parameters = mi.traverse(scene)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.value"))
    dr.enable_grad(parameters[key])
    parameters.update()
    integrator = mi.load_dict({"type": "composed_prb", "max_depth": 3})
    dr.backward(dr.mean(mi.render(scene, parameters, integrator=integrator, spp=4), axis=None))
    assert dr.all(dr.grad(parameters[key]) > 0, axis=None)
""")


def test_every_class_that_derives_from_mitsuba_is_variant_bound() -> None:
    """If it were not, it would keep the base class of the first variant after another is
    selected."""
    bound, others = set(), []
    classes = [
        node
        for file in sorted((ROOT / "mitsuba_ext").rglob("*.py"))
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    ]
    for node in classes:
        if "variant_bound" in map(ast.unparse, node.decorator_list):
            bound.add(node.name)
    for node in classes:
        bases = {ast.unparse(base) for base in node.bases}
        derives = bases & bound or any(base.startswith("mi.") for base in bases)
        if derives and node.name not in bound:
            others.append(node.name)
    assert len(bound) > 10
    assert not others


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import mitsuba_ext, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); load_all()",
        "import mitsuba as mi; mi.set_variant('scalar_rgb'); import mitsuba_ext;"
        "mi.set_variant('llvm_ad_rgb'); load_all()",
        "import mitsuba_ext.startup.runtime, mitsuba as mi; mi.set_variant('llvm_ad_rgb');"
        "import mitsuba_ext; load_all()",
    ],
    ids=["import, variant", "scalar, import, variant", "runtime, variant, import"],
)
def test_the_import_may_come_before_or_after_the_variant(code):
    _run(code)


def test_plugins_work_in_every_variant_in_turn_and_render_there():
    _run(f"""{QUICK}
import mitsuba_ext, mitsuba as mi
from mitsuba_ext.rendering.request import Request
kept = {{}}
for variant in {LLVM_VARIANTS!r} * 2:
    mi.set_variant(variant)
    load_all()
    scene = mi.load_dict({{
        "type": "scene", "e": {{"type": "constant"}},
        "s": {{"type": "sphere", "center": [0, 0, 3]}},
        "c": {{"type": "perspective", "film": {{"type": "hdrfilm", "width": 2, "height": 2}}}},
        "i": {{"type": "neepp"}}}})
    image = mi.render(scene, spp=4).numpy()
    assert (image > 0).all(), image
    nested = mi.load_dict({{"type": "reweighted_lens", "nested": {{"type": "pss_guided"}}}})
    pilots = nested.plan_learning(Request(scene, scene.sensors()[0]), 256).pilots
    assert pilots, "it learns, whatever variants there were before"
    kept[variant] = scene  # earlier variants' objects live on
""")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux only")
def test_one_core_is_enough_to_read_and_write_images(tmp_path):
    """Mitsuba alone waits for ever there."""
    _run(f"""
import os
os.sched_setaffinity(0, {{min(os.sched_getaffinity(0))}})
import mitsuba_ext, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
mi.Bitmap(dr.ones(mi.TensorXf, (4, 4, 3))).write({str(tmp_path / "image.exr")!r})
assert mi.Bitmap({str(tmp_path / "image.exr")!r}).width() == 4
""")


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_mono_polarized"])
def test_the_error_for_an_unsupported_variant_names_the_supported_ones(variant):
    names = plugin_folders.plugin_names()["integrators"]
    output = _run(f"""
import mitsuba_ext, mitsuba as mi
mi.set_variant({variant!r})
for name in {names!r}:
    try:
        mi.load_dict({{"type": name, "max_depth": 3}})
    except RuntimeError as error:
        print(str(error).splitlines()[-1])
""")
    for name in names:
        assert f'"{name}" does not work in the variant "{variant}"' in output
    assert all(supported in output for supported in runtime.SUPPORTED_VARIANTS)


@pytest.mark.usefixtures("variant")
def test_a_scene_names_every_parameter_in_xml():
    common = '''<integer name="pilot_spp" value="2"/> <integer name="max_depth" value="-1"/>
        <integer name="rr_depth" value="9"/> <boolean name="hide_emitters" value="true"/>
        <float name="timeout" value="5"/> <string name="aovs" value="d:depth"/>'''
    roulette = '''<string name="law" value="affine"/> <float name="slope" value="4"/>
        <integer name="refine" value="0"/> <float name="max_memory" value="8"/>
        <integer name="grid" value="7"/> <float name="floor" value="0.5"/>'''
    composed = (
        f'{common} <sampler name="shadow_test" type="visibility_roulette">{roulette}</sampler>'
    )
    neepp = f'''{common} {roulette} <boolean name="rejection" value="true"/>
        <string name="light_sampling" value="uniform"/>'''
    for name, parameters in (("neepp", neepp), ("composed_path", composed)):
        integrator = mi.load_string(
            f'<scene version="3.0.0"><integrator type="{name}">{parameters}</integrator></scene>'
        ).integrator()
        for text in ("law = affine", "slope = 4.0", "refine = 0", "max_memory = 8.0", "grid = 7",
                     "pilot_spp = 2", "floor = 0.5", "max_depth = -1", "rr_depth = 9",
                     "hide_emitters = True", "timeout = 5.0", "aovs = d"):  # fmt: skip
            assert text in str(integrator), (text, str(integrator))
