"""The power of lights, and choices by power: no light that emits is left out."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.lights.power import emitter_powers
from mitsuba_ext.scene.lights.weights import power_weights
from mitsuba_ext.techniques.linear_lights.linear_lights import LinearChoice
from mitsuba_ext.transport.light_table import LightTable, OneRow
from mitsuba_ext.util.spectra import brightness
from tests.support.maps import connect, floor, lamp, surface

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 16


def _spot(image: np.ndarray | None = None) -> dict:
    look = mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
    spot = {"type": "spot", "to_world": look, "cutoff_angle": 30, "intensity": 3.0}
    if image is not None:
        bitmap = mi.Bitmap(np.repeat(image[..., None], 3, axis=2).astype(np.float32))
        spot["texture"] = {"type": "bitmap", "bitmap": bitmap}
    return spot


def _texel(size: int = 1) -> np.ndarray:
    """64 by 64, of which one (or a square) is bright."""
    image = np.zeros((64, 64))
    image[40 : 40 + size, 20 : 20 + size] = 900
    return image


def _by_rays(emitter: mi.Emitter) -> float:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1 << 20)
    numbers = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
    return float(dr.mean(brightness(emitter.sample_ray(0.0, *numbers)[1]))[0])


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"], indirect=True)
def test_powers_agree_with_the_rays_that_mitsuba_sends_out(variant):
    lights = {
        "texel": _spot(_texel(3)),
        "gradient": _spot(np.add.outer(np.arange(5.0), np.arange(9.0))),
        "spot": _spot(),
        "lamp": lamp(0, 0, 1),
        "point": {"type": "point", "position": [0, 0, 1]},
        "sun": {"type": "directional", "direction": [0, 1, -1]},
        "sky": {"type": "constant", "radiance": 2.0},
    }
    scene = floor(**lights)
    powers = emitter_powers(scene)
    expected = [_by_rays(emitter) for emitter in scene.emitters()]
    assert powers == pytest.approx(expected, rel=0.05)


def test_light_from_infinity_does_not_depend_on_merged_rectangles():
    """Mitsuba does not know how large they are."""
    def rectangle(x: float) -> dict:
        return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([x, 0, 0]),
                "bsdf": {"type": "diffuse"}}  # fmt: skip

    scene = mi.load_dict({"type": "scene", "a": rectangle(-3), "b": rectangle(3), "sky": {
        "type": "constant"}, "sun": {"type": "directional", "direction": [0, 0, -1]}})
    assert len(scene.shapes()) == 1, "merged"
    powers = dict(zip((e.class_name() for e in scene.emitters()), emitter_powers(scene)))
    square = 4**2 + 1**2  # of the radius
    assert powers["ConstantBackgroundEmitter"] == pytest.approx(4 * np.pi**2 * square, rel=0.01)
    assert powers["DirectionalEmitter"] == pytest.approx(np.pi * square, rel=0.01)


def test_lights_with_black_samples_are_chosen_and_lights_without_weight_are_not():
    scene = floor(
        lamp=lamp(0, 0, 1), black=lamp(0.5, 0, 1, radiance=0.0),
        off={"type": "point", "position": [0, 0, 1], "sampling_weight": 0.0},
    )
    cells = LightCells(scene, None)
    weight = power_weights(scene, cells).numpy()
    is_off = np.array([e.sampling_weight() == 0 for e in scene.emitters()])[cells.emitter_index]
    assert (weight[~is_off] > 0).all() and (weight[is_off] == 0).all() and is_off.sum() == 1
    black = floor(a=lamp(0, 0, 1, radiance=0.0), b=lamp(0, 0, 2, radiance=0.0))
    assert (power_weights(black, LightCells(black, None)).numpy() > 0).all()


def test_textures_that_cannot_choose_wavelengths_have_a_power():
    """``path`` does not ask them to."""
    board = {"type": "checkerboard", "color0": 0.0, "color1": 2.0}
    lamps = {"board": lamp(0, 0, 1), "even": lamp(0.5, 0, 1)}
    lamps["board"]["emitter"]["radiance"] = board
    slide = {"type": "projector", "to_world": _spot()["to_world"], "irradiance": board}
    scene = floor(spot={**_spot(), "texture": board}, plain=_spot(), slide=slide, **lamps)
    powers = emitter_powers(scene)
    spots = [p for p, e in zip(powers, scene.emitters()) if e.class_name() == "SpotLight"]
    areas = [p for p, e in zip(powers, scene.emitters()) if e.class_name() == "AreaLight"]
    assert spots[0] == pytest.approx(spots[1], rel=0.05)
    assert areas[0] == pytest.approx(areas[1], rel=0.2)
    assert (power_weights(scene, LightCells(scene, None)).numpy() > 0).all()


def _target(scene: mi.Scene) -> tuple[float, float]:
    """A point of the floor that the bright texel lights."""
    u = np.linspace(-1, 1, 512, dtype=np.float32)
    si = surface(mi.Point3f(np.tile(u, 512), np.repeat(u, 512), 0), width=512**2)
    spot = next(e for e in scene.emitters() if e.class_name() == "SpotLight")
    value = spot.sample_direction(si, mi.Point2f(0.5))[1].x.numpy()
    brightest = value.argmax()
    assert 0 < (value > 0).mean() < 1e-2
    return float(u[brightest % 512]), float(u[brightest // 512])


@pytest.mark.parametrize("by", ["power", "linear"])
def test_a_spot_of_one_bright_texel_is_not_lost_beside_a_lamp(by: str):
    scene = floor(spot=_spot(_texel()), lamp=lamp(0.3, 0, 1, radiance=3.0))
    if by == "power":
        cells = LightCells(scene, None)
        selection = LightTable(OneRow(), cells, power_weights(scene, cells))
    else:
        selection = LinearChoice(scene)
    si = surface((*_target(scene), 0), width=LANES)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, LANES)
    _ds, weight, _choice, _state = connect(selection, scene, sampler, si)
    chosen = weight.x.numpy()
    exact = sum(
        float(dr.mean(emitter.sample_direction(si, sampler.next_2d())[1].x)[0])
        for emitter in scene.emitters()
    )
    assert abs(chosen.mean() - exact) < 0.05 * exact
    assert chosen.std() / np.sqrt(LANES) < 0.015 * exact
