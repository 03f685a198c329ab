"""The files, bitmaps, tensors and parameters that ``heightfield`` reads, or refuses."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.heightfields import (
    heightfield,
    interaction,
    make_rays,
    mesh_of,
    rays_at,
    terrain,
)

pytestmark = pytest.mark.usefixtures("variant")


def heights_at_vertices(shape: mi.Shape, rows: int, columns: int) -> np.ndarray:
    """What rays straight down find at vertices, close to their sides within the grid."""
    y, x = np.mgrid[0:rows, 0:columns]
    p = np.stack([2 * x / (columns - 1) - 1, 2 * y / (rows - 1) - 1, np.full(x.shape, 9)], axis=-1)
    p[..., :2] *= 1 - 1e-6
    p = p.reshape(-1, 3)
    si = interaction(shape, make_rays(p, p - [0, 0, 1]))
    assert dr.all(si.is_valid())
    return np.array(si.p.z).reshape(rows, columns)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
@pytest.mark.parametrize("channels", [1, 3])
def test_image_files_are_read_as_they_are_stored(tmp_path, dtype, channels):
    rng = np.random.default_rng(0)
    if dtype.startswith("uint"):
        file, largest = tmp_path / "heights.png", np.iinfo(dtype).max
        pixels = rng.integers(0, largest, (7, 5, channels), endpoint=True).astype(dtype)
    else:
        file, largest = tmp_path / "heights.exr", 1
        pixels = rng.uniform(-2, 2, (7, 5, channels)).astype(dtype)
        pixels[0, 0] = 2e-6  # not normalized in half precision
    mi.Bitmap(pixels).write(str(file))
    shape = mi.load_dict({"type": "heightfield", "filename": str(file), "scale": 2.0})
    expected = 2 * pixels[..., 0].astype(np.float64) / largest
    assert np.abs(heights_at_vertices(shape, 7, 5) - expected).max() < 1e-4
    at = shape.lightweight.tree.heights.at
    stored = at(mi.UInt32([0, 4, 2]), mi.UInt32([0, 3, 6])).numpy()
    assert np.array_equal(stored, pixels[[0, 3, 6], [0, 4, 2], 0].astype(np.float32))


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_spectral_variants_read_the_same_heights(variant):
    pixels = np.random.default_rng(0).random((6, 5, 3)).astype(np.float32)
    shape = mi.load_dict({"type": "heightfield", "bitmap": mi.Bitmap(pixels)})
    assert np.abs(heights_at_vertices(shape, 6, 5) - pixels[..., 0]).max() < 1e-4


def test_tensors_are_heights():
    heights = terrain(6, 9)
    for data in (heights, heights[..., None], np.stack([heights, heights * 0], axis=-1)):
        shape = mi.load_dict({"type": "heightfield", "data": mi.TensorXf(data)})
        assert np.abs(heights_at_vertices(shape, 6, 9) - heights).max() < 1e-4


def test_texture_of_the_same_image_is_at_the_same_place():
    pixels = np.random.default_rng(5).random((16, 16, 1)).astype(np.float32)
    texture = mi.load_dict({
        "type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest",
    })  # fmt: skip
    # In the middle of texels; the same place on the rectangle
    y, x = np.mgrid[0:16, 0:16]
    p = np.stack([(2 * x + 1) / 16 - 1, (2 * y + 1) / 16 - 1, np.full(x.shape, 9)], axis=-1)
    rays = make_rays(p.reshape(-1, 3), p.reshape(-1, 3) - [0, 0, 1])
    si = interaction(heightfield(pixels[..., 0]), rays)
    rectangle = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
    assert np.allclose(si.uv, rectangle.ray_intersect(rays).uv, atol=1e-6)
    assert np.array_equal(np.array(texture.eval_1(si)).reshape(16, 16), pixels[..., 0])
    # Half a texel from the vertex
    assert np.abs(np.array(si.p.z) - pixels.ravel()).mean() < 0.2


def test_grid_of_one_cell_is_the_rectangle():
    shape = heightfield(np.zeros((2, 2), np.float32))
    rectangle = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
    rays = rays_at(mi.ScalarBoundingBox3f([-1, -1, -1], [1, 1, 1]), "random", 2000)
    si, expected = interaction(shape, rays), rectangle.ray_intersect(rays)
    valid = expected.is_valid()
    assert dr.all(si.is_valid() == valid)
    for name in ("p", "uv", "dp_du", "dp_dv", "n"):
        found = dr.select(valid, getattr(si, name) - getattr(expected, name), 0)
        assert dr.max(dr.max(dr.abs(found)))[0] < 1e-5


def test_scene_has_the_bounds_of_the_surface():
    heights = terrain(8, 8)
    shape, mesh = heightfield(heights, scale=-3.0), mesh_of(-3 * heights, mi.ScalarTransform4f())
    assert np.allclose(shape.bbox().min, mesh.bbox().min, atol=1e-5)
    assert np.allclose(shape.bbox().max, mesh.bbox().max, atol=1e-5)


def test_scale_of_zero_makes_it_flat():
    shape = heightfield(terrain(8, 8), scale=0.0)
    assert np.abs(heights_at_vertices(shape, 8, 8)).max() < 1e-6


def test_str_shows_the_state():
    text = str(heightfield(np.zeros((3, 4), np.float32), scale=2.0, flip_normals=True))
    for line in ("columns = 4", "rows = 3", "stored = float32", "scale = 2"):
        assert f"{line},\n" in text
    assert "face_normals = false,\n  flip_normals = true\n" in text


def _with_nan() -> np.ndarray:
    values = np.zeros((4, 6), np.float32)
    values[2, 3] = np.nan
    return values


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({}, 'one of "filename", "bitmap" and "data", found none'),
        ({"bitmap": np.zeros((3, 3)), "filename": "a.png"}, "found filename and bitmap"),
        ({"filename": "missing.png"}, "there is no file"),
        ({"filename": __file__}, "cannot be read as an image"),
        ({"filename": 3}, '"filename" is 3; it must be of type string'),
        ({"bitmap": np.zeros((1, 5))}, "has 5 x 1 values; each side must have 2 to 32769"),
        ({"bitmap": np.zeros((2, 32770))}, "each side must have 2 to 32769"),
        ({"bitmap": _with_nan()}, "the value nan in column 3 of row 2"),
        ({"bitmap": np.zeros((3, 3)), "scale": "a"}, '"scale" is \'a\'; it must be of type float'),
        ({"bitmap": np.zeros((3, 3)), "face_normals": 1}, "must be of type bool"),
        ({"bitmap": np.zeros((3, 3)), "to_world": 1}, "must be a transform"),
        ({"bitmap": np.zeros((3, 3)), "to_world": "flat"}, "can be inverted"),
        ({"bitmap": np.zeros((3, 3)), "emitter": {"type": "area"}}, "an area light"),
        ({"bitmap": np.zeros((3, 3)), "other": {"type": "homogeneous"}}, "it cannot hold"),
        ({"bitmap": np.zeros((3, 3)), "resolution": 3}, "resolution"),
        ({"data": 3}, "must be a tensor of floats"),
        ({"data": "line"}, "it must be (rows, columns)"),
    ],
)
def test_wrong_parameters_are_refused_in_one_sentence(parameters, message):
    values = dict(parameters)
    if isinstance(values.get("bitmap"), np.ndarray):
        values["bitmap"] = mi.Bitmap(values["bitmap"].astype(np.float32)[..., None])
    if values.get("to_world") == "flat":
        values["to_world"] = mi.ScalarTransform4f().scale([1, 0, 1])
    if values.get("data") == "line":
        values["data"] = mi.TensorXf([1, 2, 3])
    with pytest.raises(RuntimeError) as error:
        mi.load_dict({"type": "heightfield", **values})
    assert message in str(error.value) and "heightfield" in str(error.value)
