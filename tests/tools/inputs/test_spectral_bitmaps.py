"""Bitmaps of scene dicts in spectral variants, where Mitsuba converts their pixels in place."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.inputs.scenes import load_scene
from tests.support.statistical import assert_same_image

pytestmark = [
    pytest.mark.usefixtures("variant"),
    pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True),
]

PIXELS = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)


def _cube(bitmap: mi.Bitmap, **more) -> dict:
    texture = {"type": "bitmap", "bitmap": bitmap}
    return {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture}, **more}


def _scene(**more) -> dict:
    """A scene at the end of the shutter interval."""
    view = mi.ScalarTransform4f().look_at([1, -5, 2], [0.2, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": view, "film": film,
              "shutter_open": 1.0, "shutter_close": 1.0}  # fmt: skip
    return {"type": "scene", "sky": {"type": "constant"}, "sensor": sensor, **more}


def test_a_scene_dict_can_be_loaded_twice(variant):
    bitmap = mi.Bitmap(PIXELS.copy())
    source = _scene(cube=_cube(bitmap))
    first, second = (load_scene(source) for _ in range(2))
    assert first.content_hash == second.content_hash
    data = [mi.traverse(loaded.scene.shapes()[0])["bsdf.reflectance.data"].numpy()
            for loaded in (first, second)]  # fmt: skip
    np.testing.assert_array_equal(*data)
    np.testing.assert_array_equal(np.array(bitmap), PIXELS)


def test_a_moving_object_has_the_texture_that_it_has_at_rest(variant):
    cube = _cube(mi.Bitmap(PIXELS.copy()))
    moving = _scene(cube={"type": "moving", "translate": [0.4, 0, 0], "what": cube})
    moved = mi.ScalarTransform4f().translate([0.4, 0, 0])
    resting = _scene(cube=_cube(mi.Bitmap(PIXELS.copy()), to_world=moved))
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3})
    images = [
        np.array(mi.render(mi.load_dict(scene), integrator=integrator, spp=16))
        for scene in (moving, resting)
    ]
    assert_same_image(*images, share=0.95)
