"""``mitsuba-ext replay``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mitsuba_ext.compare import read_exr

pytestmark = pytest.mark.usefixtures("variant")


def test_a_pixel_of_a_render_is_replayed(run, make_scene, tmp_path) -> None:
    scene, image = make_scene(), tmp_path / "image.exr"
    assert run("render", scene, "-o", image, "--seed", 3)[0] == 0
    code, out, err = run("replay", scene, "--seed", 3, "--pixel", "4,2", "--top", 2, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert (found["integrator"], found["seed"]) == ("path", 3)
    (pixel,) = found["pixels"]
    channels = read_exr(image)[0]
    expected = [channels[name][2, 4] for name in "RGB"]
    np.testing.assert_allclose(pixel["value"], expected, rtol=1e-3)  # the file has halves
    assert pixel["spp"] == 4 and len(pixel["paths"]) == 2
    first, *_rest = pixel["paths"][0]["vertices"]
    assert first["kind"] == "surface" and len(first["position"]) == 3


def test_the_brightest_pixels_are_shown_as_tables_and_as_a_picture(
    run, make_scene, tmp_path
) -> None:
    picture = tmp_path / "paths.jpg"
    code, out, _err = run(
        "replay", make_scene(), "--brightest", 2, "--top", 1, "--size", "16x12", "-o", picture
    )
    assert code == 0 and picture.stat().st_size > 5000
    lines = out.splitlines()
    assert sum(line.startswith("pixel ") for line in lines) == 2
    assert sum(line.startswith("sample ") for line in lines) == 2
    assert any(" ConstantBackgroundEmitter " in line for line in lines)
    assert lines[-1] == str(picture)


def test_a_picture_can_have_the_image_of_the_render(run, make_scene, tmp_path) -> None:
    scene, image, picture = make_scene(), tmp_path / "image.exr", tmp_path / "paths.png"
    assert run("render", scene, "-o", image)[0] == 0
    command = ("replay", scene, "--pixel", "4,2", "-o", picture)
    assert run(*command, "--image", image)[0] == 0
    drawn = picture.read_bytes()
    assert run(*command)[0] == 0 and picture.read_bytes() != drawn
    code, _out, err = run(*command, "--image", image, "--size", "16x12")
    assert code == 2 and "8x6 pixels, and the render 16x12" in err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--pixel", "8,0"), "the pixel 8,0 is not in the image, which has 8x6 pixels"),
        (("--pixel", "8"), 'expected a column and a row like 120,45, found "8"'),
        (("--pixel", "1,1", "--brightest", 2), "--pixel and --brightest cannot be combined"),
        (("--image", "image.exr"), "--image needs --output"),
        (("-o", "paths.exr"), "a picture of paths can be .png"),
        (("--integrator", "pssmlt"), "cannot be replayed"),
        (("--integrator", "neepp:timeout=3"), 'a render with "timeout" cannot be replayed'),
    ],
)
def test_what_cannot_be_done_is_one_line(run, make_scene, options, message) -> None:
    code, out, err = run("replay", make_scene(), *options)
    assert (code, out) == (2, "") and message in err and err.count("\n") <= 2


def test_pixels_without_noise_do_not_stand_out(run, make_scene) -> None:
    code, out, _err = run("replay", make_scene(body=""))
    assert code == 0 and "no pixel stands out" in out
