"""What a lens sees at which depth: the light tracer's lens maps and ``ecoc_dof`` ask the same
module."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.defocus.layer_samples import outside_pixels
from mitsuba_ext.estimators.defocus.layered_job import LayeredJob
from mitsuba_ext.estimators.light_paths.depth_maps import DepthMaps
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.transport.lens_view import LensView
from mitsuba_ext.transport.path_decisions import SceneQuery
from tests.support.stage import area, diffuse, film, sensor

pytestmark = pytest.mark.usefixtures("variant")

#: Of the wall, and of the pane before it.
WALL, PANE = 5.0, 2.0


def a_scene(scale: float = 1.0, pane: dict | None = None) -> mi.Scene:
    """A wall across the axis of the lens, far wider than the film sees."""
    to = mi.ScalarTransform4f()
    across = to.look_at([0, 0, 0], [1, 2, 3], [0, 0, 1])

    def at(depth: float) -> mi.ScalarTransform4f:
        place = across @ to.translate([0, 0, depth * scale])
        return place.rotate([0, 1, 0], 180).scale(20 * scale)

    camera = sensor("thinlens", aperture_radius=0.2 * scale, focus_distance=3.0 * scale,
                    near_clip=0.01 * scale, far_clip=100 * scale, film=film(16, 12))  # fmt: skip
    things = {"wall": {"type": "rectangle", "to_world": at(WALL), "emitter": area(1.0)}}
    if pane:
        things["pane"] = {"type": "rectangle", "to_world": at(PANE), "bsdf": pane}
    return mi.load_dict(
        {"type": "scene", "sensor": {**camera, "to_world": across}, **things}, optimize=False
    )


def a_view(scene: mi.Scene) -> LensView:
    return LensView(scene, scene.sensors()[0], SceneQuery())


def a_ray(view: LensView, aperture: mi.Point2f | float = 0.5) -> mi.Ray3f:
    return view.ray(mi.Point2f([0.1, 0.5, 0.8], [0.3, 0.5, 0.9]), aperture, mi.Float(0))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_depths_are_measured_along_the_axis_from_any_point_of_the_lens(scale):
    view = a_view(a_scene(scale))
    for aperture in (0.5, mi.Point2f(0.9, 0.2)):
        _p, inverse_depth = view.meet(a_ray(view, aperture))
        assert np.allclose(inverse_depth.numpy(), 1 / (WALL * scale), rtol=1e-4)


def test_maps_of_the_lens_and_blurs_of_the_film_have_the_same_depths():
    scene = a_scene()
    lens = scene.sensors()[0]
    maps = DepthMaps(scene, lens, SceneQuery(), pieces=2, most_pixels=16)
    integrator = mi.load_dict({"type": "ecoc_dof", "nested": {"type": "path"}})
    job = LayeredJob(integrator, Request(scene, lens, 0, 1))
    assert np.allclose(job.lens.blur_at(maps.places.z).numpy(), job.blurs[0, 0], rtol=1e-4)
    assert np.allclose(job.blurs, job.lens.blur(mi.Float(WALL)).numpy(), rtol=1e-4)


def test_light_paths_end_at_panes_that_the_look_of_a_picture_passes():
    pane = {"type": "mask", "opacity": 0.0, "bsdf": diffuse(0.5)}
    view = a_view(a_scene(pane=pane))
    _p, inverse_depth = view.meet(a_ray(view))
    assert np.allclose(inverse_depth.numpy(), 1 / PANE, rtol=1e-4)

    def passes(si, side, active):
        return dr.mean(si.bsdf().eval_null_transmission(si, active & si.is_valid())) > 0.5

    si, _side = view.surface_behind(a_ray(view), passes, mi.Bool(True))
    assert np.allclose(view.depth(si.p).numpy(), WALL, rtol=1e-4)


def test_nothing_is_seen_at_infinity():
    view = a_view(a_scene())
    back = a_ray(view)
    back.d = -back.d
    _p, inverse_depth = view.meet(back)
    assert not inverse_depth.numpy().any()
    behind = view.inverse_depth(mi.Point3f(-1, -2, -3), mi.Bool(True))
    assert float(behind[0]) == 0


def test_samples_around_the_film_are_taken_where_these_are_blurred_into_it():
    blurs = np.zeros((60, 80))
    assert outside_pixels(blurs, 10).sum() == 42 * 62 - 40 * 60 - 4, "those that touch the film"
    blurs[30, 77] = 20.0
    found = outside_pixels(blurs, 10)
    assert found[30, 77] and not found[30, 76], "it is blurred into the film"
    blurs[:] = 0
    blurs[25:35, 60:70] = -7.0
    found = outside_pixels(blurs, 10)
    assert found[25:35, 70:78].all() and not found[:, 78:].any(), "the film is blurred out of it"
    assert not found[10:50, 10:70].any() and found[30, :10].sum() == 1
