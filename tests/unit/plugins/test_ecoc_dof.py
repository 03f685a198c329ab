"""Depth of field by a filter is close to a thin lens on any film; errors are clear."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.defocus.layer_samples import least_blur_around
from tests.support.defocus import EMITTED, PATH, ecoc, rendered, signs, thin_lens
from tests.support.stage import area, diffuse, film, rectangle, sensor, stage
from tests.support.statistical import batches

pytestmark = pytest.mark.usefixtures("variant")


@pytest.mark.slow
def test_picture_is_closer_to_a_thin_lens_than_the_filter_of_the_source():
    scene = signs()
    reference = rendered(scene, mi.load_dict(EMITTED), 4096)
    error = {
        name: np.sqrt(((rendered(scene, ecoc(filter=name), 64) - reference) ** 2).mean())
        for name in ("lens", "effective")
    }
    assert error["lens"] < min(0.2 * reference.mean(), 0.5 * error["effective"]), error


@pytest.mark.parametrize("changes", [
    {"rfilter": {"type": "gaussian"}}, {"rfilter": {"type": "lanczos"}, "sample_border": True},
    {"crop_width": 7, "crop_height": 5, "crop_offset_x": 3, "crop_offset_y": 1},
], ids=["gaussian", "lanczos", "crop"])  # fmt: skip
def test_a_white_film_stays_white(changes):
    """A white ball near the lens in a white environment."""
    ball = {"type": "sphere", "center": [0, -3, 1], "radius": 0.2, "emitter": area(1.0)}
    camera = thin_lens(pixel_format="rgba", **changes)
    scene = mi.load_dict(
        {"type": "scene", "sky": {"type": "constant"}, "ball": ball, "sensor": camera}
    )
    image = rendered(scene, ecoc(), 8)
    assert image.shape == (5, 7, 4) if "crop_width" in changes else (9, 12, 4)
    assert np.allclose(image, 1, rtol=1e-3)


def test_corners_of_wide_circles_see_objects_far_around_the_film():
    """A white panel ends 4.5 of 32 pixels beside the film, where circles have a radius of 8."""
    place = mi.ScalarTransform4f().translate([0, -2, 0.6]).rotate([1, 0, 0], 90)
    # At the distance of the panel, half of the film is 2 tan(22.5°) = 0.828 wide
    panel = {"type": "rectangle", "to_world": place.scale(0.828 * 20.5 / 16), "emitter": area(1.0)}
    view = mi.ScalarTransform4f().look_at([0, -4, 0.6], [0, 0, 0.6], [0, 0, 1])
    lens = {"aperture_radius": 0.84, "focus_distance": 4.0}
    camera = sensor("thinlens", **lens, film=film(32, 32), to_world=view)
    scene = mi.load_dict({"type": "scene", "sensor": camera, "panel": panel})
    expected, found = (rendered(scene, x, 256) for x in (mi.load_dict(EMITTED), ecoc()))
    corners = np.ix_([0, 1, 2, -3, -2, -1], [0, 1, 2, -3, -2, -1])
    assert found[corners].mean() == pytest.approx(expected[corners].mean(), abs=0.02)


@pytest.mark.slow
def test_a_crop_is_the_part_of_the_whole_picture():
    whole = rendered(signs(), ecoc(), 64)
    crop = {"crop_width": 20, "crop_height": 16, "crop_offset_x": 8, "crop_offset_y": 4}
    part = rendered(signs(**crop), ecoc(), 64)
    # Lens points of neighbouring pixels are turned by other angles, which begin at the margin
    assert np.abs(part - whole[4:20, 8:28]).mean() < 0.05 * whole.mean()


@pytest.mark.slow
def test_alpha_is_blurred_too():
    ball = {"type": "sphere", "center": [0, -3, 1], "radius": 0.15, "emitter": area(1.0)}
    camera = thin_lens(24, 24, pixel_format="rgba")
    scene = mi.load_dict({"type": "scene", "ball": ball, "sensor": camera})
    image, reference = rendered(scene, ecoc(), 64), rendered(scene, mi.load_dict(EMITTED), 1024)
    assert np.abs(image[..., 3] - reference[..., 3]).mean() < 0.03
    assert ((image[..., 3] > 0.1) & (image[..., 3] < 0.9)).sum() > 20


def test_equal_seeds_give_equal_images():
    scene = mi.load_dict(stage(camera=thin_lens()))
    first, same, other = batches(scene, ecoc(PATH), 8, [5, 5, 6])
    assert np.allclose(first, same, rtol=1e-4) and not np.allclose(first, other, rtol=1e-2)


@pytest.mark.parametrize("spp, hidden_spp", [(1, 0), (3, 2), (9, 0)])
def test_few_samples_are_enough_and_count_in_the_image(spp, hidden_spp):
    scene = mi.load_dict(stage(camera=thin_lens(1, 1) if spp == 3 else thin_lens(5, 3)))
    integrator = ecoc(PATH, hidden_spp=hidden_spp)
    image = rendered(scene, integrator, spp)
    assert np.isfinite(image).all() and integrator.statistics.spp == spp


def test_a_cancelled_render_is_a_picture_of_its_finished_samples():
    scene = mi.load_dict(stage(camera=thin_lens(5, 3)))
    integrator = ecoc(PATH)
    integrator.samples_per_pass = 2
    integrator.progress = lambda done: integrator.cancel()
    image = rendered(scene, integrator, 8)
    assert integrator.statistics.interrupted and integrator.statistics.spp == 2
    assert np.isfinite(image).all() and image.mean() > 0


@pytest.mark.slow
def test_a_perspective_with_a_lens_given_is_a_thin_lens():
    optics = {"aperture_radius": 0.3, "focus_distance": 4.0}
    given = mi.load_dict(stage(camera=sensor(film=film(12, 9))))
    own = mi.load_dict(stage(camera=thin_lens()))
    images = batches(given, ecoc(PATH, **optics), 256, [1]), batches(own, ecoc(PATH), 256, [1])
    assert np.abs(images[0] - images[1]).mean() < 0.05 * images[1].mean()


@pytest.mark.parametrize("nested", [
    {"type": "composed_path", "max_depth": 2},
    *(pytest.param(nested, marks=pytest.mark.slow) for nested in [
        {"type": "composed_path", "max_depth": 2, "aovs": "d:depth"},
        {"type": "neepp", "max_depth": 2, "pilot_spp": 4},
        {"type": "pss_guided", "max_depth": 3, "always_guide": True, "regions": "tiles", "tile": 5},
        {"type": "bdpt", "max_depth": 3, "light_image": False},
    ]),
], ids=lambda nested: nested["type"])  # fmt: skip
def test_any_integrator_that_samples_camera_rays_can_be_nested(nested):
    scene = mi.load_dict(stage(camera=thin_lens()))
    integrator = ecoc(nested)
    image = rendered(scene, integrator, 32)
    path = rendered(scene, mi.load_dict({**PATH, "max_depth": nested["max_depth"]}), 512)
    assert image[..., :3].mean() == pytest.approx(path.mean(), rel=0.1)
    if "aovs" in nested:
        assert image.shape[2] == 4 and 2 < image[..., 3].mean() < 6


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_brightness_agrees_with_the_thin_lens_in_other_variants(variant):
    scene = mi.load_dict(stage(camera=thin_lens()))
    image, path = rendered(scene, ecoc(PATH), 128), rendered(scene, mi.load_dict(PATH), 512)
    assert image.mean() == pytest.approx(path.mean(), rel=0.05)


@pytest.mark.slow
def test_layers_look_through_panes_and_holes():
    """A mask that lets everything through stands before the lens."""
    hole = {"type": "mask", "opacity": 0.0, "bsdf": diffuse(0.5)}
    place = mi.ScalarTransform4f().translate([0, -3.2, 1]).rotate([1, 0, 0], 90)
    pane = rectangle(place, bsdf=hole)
    scene = mi.load_dict(stage(camera=thin_lens(), pane=pane))
    without = mi.load_dict(stage(camera=thin_lens()))
    nested = {"type": "path", "max_depth": 4}
    image, expected = rendered(scene, ecoc(nested), 128), rendered(without, ecoc(nested), 128)
    assert np.abs(image - expected).mean() < 0.1 * expected.mean()


def test_hidden_things_are_looked_for_around_edges_only():
    blurs = np.full((64, 64), -10.0)
    blurs[:, :32] = 6.0
    least = least_blur_around(blurs, -10.0)
    assert np.isinf(least[:, 32:]).all(), "nothing is behind what is farthest"
    assert (least[:, 8:32] == -10).all() and np.isinf(least[:, :8]).all()
    slope = np.repeat(np.linspace(-10, 10, 64)[None], 64, 0)
    assert np.isinf(least_blur_around(slope, -12.0)).all()


# ---- Errors ----


@pytest.mark.parametrize("plugin, parameters, message", [
    ("perspective", {}, 'has no "aperture_radius": use a "thinlens"'),
    ("perspective", {"aperture_radius": 0.1}, 'has no "focus_distance"'),
    ("orthographic", {"aperture_radius": 0.1, "focus_distance": 2.0}, "has no lens"),
])  # fmt: skip
def test_a_sensor_without_a_lens_is_refused(plugin, parameters, message):
    scene = mi.load_dict(stage(camera=sensor(plugin)))
    with pytest.raises((ValueError, NotImplementedError), match=message):
        ecoc(**parameters).render(scene, spp=1)


def test_a_focus_at_infinity_is_refused_and_one_far_away_is_not():
    """Mitsuba's rays are not numbers at infinity."""
    scene = mi.load_dict(stage(camera=sensor("thinlens", aperture_radius=0.1,
                                             focus_distance=np.inf)))  # fmt: skip
    with pytest.raises(ValueError, match="give a finite one"):
        ecoc().render(scene, spp=1)
    far = sensor("thinlens", aperture_radius=1e-3, focus_distance=1e6, film=film(12, 9))
    near = sensor("thinlens", aperture_radius=1e-3, focus_distance=4.0, film=film(12, 9))
    scenes = [mi.load_dict(stage(camera=camera)) for camera in (far, near)]
    images = [rendered(scene, ecoc(PATH), 64) for scene in scenes]
    assert np.isfinite(images[0]).all()
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=0.05)


@pytest.mark.parametrize("nested, message", [
    ({"type": "bdpt"}, '"bdpt" cannot be .* set "light_image" to false'),
    ({"type": "light_tracer"}, "its light paths"),
    ({"type": "adaptive", "nested": PATH}, "distributed already"),
    ({"type": "reweighted_lens", "nested": PATH}, "sets of numbers"),
    ({"type": "ecoc_dof", "nested": PATH}, "exactly one integrator"),
    ({"type": "prb"}, "none for gradients"),
    (None, "found none"),
])  # fmt: skip
def test_integrators_that_cannot_be_nested_are_refused(nested, message):
    with pytest.raises(RuntimeError, match=message):
        ecoc(nested)


def test_nesting_it_where_its_filter_would_be_lost_is_refused():
    with pytest.raises(RuntimeError, match="a filter makes its picture"):
        mi.load_dict({"type": "adaptive", "nested": ecoc()})
    with pytest.raises(RuntimeError, match="nest the other integrator in it"):
        mi.load_dict({"type": "reweighted_time", "nested": ecoc()})


@pytest.mark.parametrize("parameters, message", [
    ({"aperture_radius": -1.0}, "at least 0"), ({"filter": "bokeh"}, "one of lens"),
    ({"hidden_spp": -1}, "at least 0"), ({"aperture": 0.1}, "aperture"),
])  # fmt: skip
def test_wrong_parameters_are_refused(parameters, message):
    with pytest.raises(RuntimeError, match=message):
        ecoc(**parameters)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
def test_a_special_film_is_refused(variant):
    band = {"type": "irregular", "wavelengths": "400, 700", "values": "1, 1"}
    special = {"type": "specfilm", "width": 4, "height": 4, "band": band}
    camera = sensor("thinlens", film=special, aperture_radius=0.1, focus_distance=4.0)
    scene = mi.load_dict(stage(camera=camera))
    with pytest.raises(NotImplementedError, match='use an "hdrfilm"'):
        ecoc().render(scene, spp=1)
