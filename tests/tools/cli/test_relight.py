"""``mitsuba-ext relight``, and light groups in scene files."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_ext.compare import read_exr
from mitsuba_ext.images import denoising, relighting
from mitsuba_ext.util.errors import InputError
from tests.support.command_line import SPHERE

pytestmark = pytest.mark.usefixtures("variant")

_LIGHTS = """<shape type="rectangle">
    <string name="light_group" value="key"/>
    <transform name="to_world"><rotate x="1" angle="180"/><translate y="1" z="6"/></transform>
    <emitter type="area"><rgb name="radiance" value="{key}, {key}, {key}"/></emitter>
  </shape>
  <emitter type="point">
    <string name="light_group" value="key"/>
    <point name="position" value="1, 1, 1"/><rgb name="intensity" value="{key}, {key}, {key}"/>
  </emitter>
  <emitter type="point" id="fill.001">
    <point name="position" value="-1, 1, 1"/><rgb name="intensity" value="2, {fill}, 2"/>
  </emitter>"""


def _colours(path) -> np.ndarray:
    planes = read_exr(path)[0]
    return np.stack([planes[colour] for colour in "RGB"], axis=2)


def test_a_relit_image_is_the_render_with_other_lights(run, make_scene, tmp_path) -> None:
    integrator = ("--integrator", "composed_path:max_depth=3,aovs=g:light_groups")
    for name, key, fill in (("a", 4, 2), ("b", 1, 3)):
        body = _LIGHTS.format(key=key, fill=fill)
        scene = make_scene(body=SPHERE + body)
        code, _, err = run("render", scene, *integrator, "-o", tmp_path / f"{name}.exr")
        assert code == 0, err
    code, _, err = run("relight", tmp_path / "a.exr", "key=0.25", "g.fill=1,1.5,1",
                       "-o", tmp_path / "mixed.exr")  # fmt: skip
    assert code == 0, err
    np.testing.assert_allclose(
        _colours(tmp_path / "mixed.exr"), _colours(tmp_path / "b.exr"), atol=1e-4
    )
    code, out, _ = run("relight", tmp_path / "a.exr")
    assert code == 0 and out.split() == ["g.fill", "g.key", "g.unnamed"]


@pytest.mark.parametrize(
    ("factors", "message"),
    [(["kez=2"], 'did you mean "key"'), (["key"], "NAME=FACTOR"), (["key=1,2"], "NAME=FACTOR"),
     (["key=-1"], "NAME=FACTOR"), (["key=nan"], "one number or three")],
)  # fmt: skip
def test_wrong_factors_are_refused(run, tmp_path, factors, message) -> None:
    from mitsuba_ext.images.image_files import write_exr

    names = [*"RGB", *(f"g.key.{colour}" for colour in "RGB")]
    write_exr(tmp_path / "a.exr", np.ones((2, 3, 6)), names, {})
    code, _, err = run("relight", tmp_path / "a.exr", *factors)
    assert code == 2 and message in err


def test_the_mixed_image_is_denoised_with_the_guides_of_the_file(monkeypatch) -> None:
    planes = {colour: np.full((2, 3), 2.0) for colour in "RGB"}
    planes.update({f"key.{colour}": np.ones((2, 3)) for colour in "RGB"})
    mixed = relighting.relight(planes, {"key": (0, 1, 3)})
    np.testing.assert_array_equal(mixed[0, 0], [1, 2, 4])
    planes.update({f"albedo.{colour}": np.ones((2, 3)) for colour in "RGB"})
    assert list(denoising.guides_of(planes)) == ["albedo"]
    with pytest.raises(InputError, match="several layers"):
        relighting.relight({**planes, **{f"a.key.{c}": planes["R"] for c in "RGB"},
                            **{f"b.nix.{c}": planes["R"] for c in "RGB"},
                            **{f"c.nix.{c}": planes["R"] for c in "RGB"}}, {"nix": 1})  # fmt: skip


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<shape type="sphere"><string name="light_group" value="key"/></shape>', "emitters"),
        ('<emitter type="point"><string name="light_group" value="a.b"/></emitter>', "a name"),
    ],
)
def test_groups_of_what_is_no_light_are_refused(run, make_scene, tmp_path, body, message) -> None:
    code, _, err = run("render", make_scene(body=body), "-o", tmp_path / "a.exr")
    assert code == 2 and "light_group" in err and message in err
