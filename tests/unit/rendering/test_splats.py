"""Light that an estimator brings to pixels other than the pixels of its camera rays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.rendering.filter_weights import mean_weights
from mitsuba_ext.rendering.render import render
from mitsuba_ext.rendering.request import Request
from mitsuba_ext.rendering.stages import Stage
from mitsuba_ext.transport.estimator import Splats
from tests.support.constant_renders import Constant, FixedSchedule, TwoStages
from tests.support.stage import film, sensor, stage
from tests.support.statistical import THRESHOLD, assert_same_image, batches, z_exact

pytestmark = pytest.mark.usefixtures("variant")


class _Moved:
    """What a walk finds, as splats: at another place of the film, and nothing for its own pixel."""

    def __init__(self, walk: Any, shift: tuple[int, int]) -> None:
        self._walk, self._shift = walk, shift

    def __call__(self, scene, sampler, rays, active):
        sample = self._walk(scene, sampler, rays, active)
        splats = Splats(
            sample.L * rays.importance * rays.weight,
            rays.position + mi.Vector2f(*self._shift),
            rays.ray.wavelengths if mi.is_spectral else None,
            mi.Bool(True),
        )
        return replace(sample, L=sample.L * 0, splats=[splats])


def _integrator(shift: tuple[int, int] | None, **parameters: Any) -> mi.Integrator:
    integrator = mi.load_dict({"type": "composed_path", "max_depth": 3, **parameters})
    if shift is not None:
        make = integrator.walk
        integrator.walk = lambda *arguments: _Moved(make(*arguments), shift)
    return integrator


def _scene(sampler: str = "independent", **changes: Any) -> mi.Scene:
    return mi.load_dict(stage(camera=sensor(film=film(24, 20, **changes), sampler=sampler)))


_GAUSSIAN = {"rfilter": {"type": "gaussian"}}
_CROP = {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 13, "crop_height": 11}


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
@pytest.mark.parametrize("changes", [{}, _GAUSSIAN, _CROP, {**_GAUSSIAN, **_CROP}],
                         ids=["box", "gaussian", "cropped", "gaussian-cropped"])  # fmt: skip
def test_splats_at_their_own_place_are_the_image(changes: dict[str, Any], sampler: str) -> None:
    """Splats are divided by the mean filter weight, and not by the weights of the samples."""
    scene = _scene(sampler, **changes)
    ours, image = (batches(scene, _integrator(shift), 16, [4])[0] for shift in ((0, 0), None))
    assert image.mean() > 0
    film = scene.sensors()[0].film()
    weights = np.array(film.develop(raw=True))[..., -1:]
    assert_same_image(ours, image * weights / (16 * mean_weights(film)[..., None]), share=1.0)


def test_splats_are_right_on_average_with_one_camera_sample() -> None:
    """This includes a filter whose weights depend on the position in the pixel: dividing by these
    weights would make the image 6 % too bright."""
    camera = sensor(film=film(24, 20, **_GAUSSIAN))
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "camera": camera})
    images = batches(scene, _integrator((3, 0)), 1, range(1, 33))
    z, error = z_exact(images[:, 3:-3, 6:-3].mean(axis=(1, 2, 3)), 1.0)
    assert abs(z) < THRESHOLD and error < 0.005


@pytest.mark.parametrize("changes", [{}, _GAUSSIAN], ids=["box", "gaussian"])
def test_splats_weigh_as_much_as_the_samples_of_their_stage(changes: dict[str, Any]) -> None:
    """Here, camera paths find all light in the first stage, and light paths in the second one."""
    scene, integrator = _scene(**changes), TwoStages(pilot_spp=24)
    light_paths = _Moved(Constant(1.0), (0, 0))
    integrator.schedule = lambda *_: FixedSchedule(
        Stage(Constant(1.0), weight=0.25), Stage(light_paths, weight=0.5)
    )
    image = render(integrator, Request(scene, scene.sensors()[0], 0, 64)).numpy()
    # A gaussian filter spreads the splats unevenly
    assert image[3:-3, 3:-3].mean() == pytest.approx(1, abs=0.003 if changes else 1e-5)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"], indirect=True)
def test_splats_have_the_colours_of_their_wavelengths(variant: str) -> None:
    scene = _scene()
    ours, image = (batches(scene, _integrator(shift), 8, [4])[0] for shift in ((0, 0), None))
    assert_same_image(ours, image, share=1.0)


@pytest.mark.parametrize("sampler", ["independent", "multijitter"])
@pytest.mark.parametrize("changes", [{}, _CROP], ids=["box", "cropped"])
def test_splats_that_are_moved_are_the_moved_image(changes: dict[str, Any], sampler: str) -> None:
    """Those that leave the crop window are lost, and nothing else."""
    scene = _scene(sampler, **changes)
    x, y = 4, -2
    ours, image = (batches(scene, _integrator(shift), 16, [4])[0] for shift in ((x, y), None))
    assert_same_image(ours[:y, x:], image[-y:, :-x], share=1.0)
    assert not ours[y:].any() and not ours[:, :x].any()


def test_splats_are_spread_by_the_filter() -> None:
    """Pixels near the border are as bright as those inside: all are divided by the filter weights
    of the camera samples, of which there are as many as splats."""
    scene = _scene("multijitter", **_GAUSSIAN)
    ours, image = (batches(scene, _integrator(shift), 256, [4])[0] for shift in ((3, 0), None))
    inside = image[:, 2:-5].mean()
    np.testing.assert_allclose(ours[:, 5:-2].mean(), inside, rtol=0.01)
    np.testing.assert_allclose(ours[:, 5:-2], image[:, 2:-5], atol=0.05 * inside, rtol=0.05)


def test_alpha_and_output_variables_come_from_the_camera_rays() -> None:
    scene = _scene(pixel_format="rgba")
    ours, image = (
        batches(scene, _integrator(shift, aovs="depth:depth"), 16, [4])[0]
        for shift in ((4, 0), None)
    )
    assert image.shape[-1] == 5 and 0 < image[..., 3].mean() < 1
    assert_same_image(ours[..., 3:], image[..., 3:], share=1.0)
    assert_same_image(ours[:, 4:, :3], image[:, :-4, :3], share=1.0)


_SPECTRAL_FILM = {
    "type": "specfilm", "component_format": "float32",
    "band": {"type": "spectrum", "value": [(400.0, 1.0), (700.0, 1.0)]},
}  # fmt: skip


@pytest.mark.parametrize("variant, changes, says", [
    ("llvm_ad_rgb", {"sample_border": True, **_GAUSSIAN}, 'set its "sample_border" to False'),
    ("llvm_ad_spectral", _SPECTRAL_FILM, 'SpecFilm": use "hdrfilm"'),
], ids=["border", "specfilm"], indirect=["variant"])  # fmt: skip
def test_films_that_cannot_take_splats_are_named(
    variant: str, changes: dict[str, Any], says: str
) -> None:
    properties = film(24, 20, **changes)
    if "band" in properties:
        del properties["pixel_format"]
    scene = mi.load_dict(stage(camera=sensor(film=properties)))
    with pytest.raises(NotImplementedError, match=f"light that reaches other pixels.*{says}"):
        _integrator((0, 0)).render(scene, spp=1)
