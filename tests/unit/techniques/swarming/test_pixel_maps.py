"""The maps of a pixel, as arrays."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.swarming.camera_map_learner import CameraMapLearner
from mitsuba_ext.techniques.swarming.cells import Cells
from mitsuba_ext.techniques.swarming.light_numbers_learner import LightNumbersLearner
from mitsuba_ext.techniques.swarming.lobe_map_learner import LobeMapLearner
from mitsuba_ext.techniques.swarming.mapped_lights import light_cells
from mitsuba_ext.techniques.swarming.mapped_lobes import lobe_cells
from mitsuba_ext.techniques.swarming.pixel_maps import light_probabilities, pixel_maps
from tests.support.statistical import load

pytestmark = pytest.mark.usefixtures("variant")

_WIDTH, _HEIGHT, _EDGE = 20, 12, 4


def _sensor(**film) -> mi.Sensor:
    film = {"type": "hdrfilm", "width": _WIDTH, "height": _HEIGHT, **film}
    return mi.load_dict({"type": "perspective", "film": film})


class _Densities:
    """Another random density for each table."""

    def __init__(self, cells: Cells, tables: int) -> None:
        mass = np.random.default_rng(5).random((tables, cells.count)) * (cells.widths > 0)
        self.mass = mass / mass.sum(1, keepdims=True)
        widths = np.where(cells.widths > 0, cells.widths, 1)
        self._table, self._count = mi.Float((self.mass / widths).ravel()), cells.count

    def density(self, table, cell, active=True) -> mi.Float:
        return dr.gather(mi.Float, self._table, table * self._count + cell, mi.Bool(active))


def _learner(kind: type, cells: Cells, maps: int = 1, border: int = 0) -> Any:
    """One that has learned, without a render."""
    across, down = (-(-(size + 2 * border) // _EDGE) for size in (_WIDTH, _HEIGHT))
    width = _WIDTH + 2 * border

    def tile(pixel: mi.UInt32) -> mi.UInt32:
        return pixel // width // _EDGE * across + pixel % width // _EDGE

    learner = kind.__new__(kind)
    learner.name, learner.cells, learner.maps = "x", cells, maps
    learner.decision = SimpleNamespace(
        maps=_Densities(cells, across * down * maps), tiles=SimpleNamespace(edge=_EDGE, tile=tile)
    )
    return learner


def _lamps() -> mi.Scene:
    weights = (1, 0, 3, 2, 5)
    return mi.load_dict({
        "type": "scene",
        **{f"lamp_{i}": {"type": "point", "sampling_weight": w} for i, w in enumerate(weights)},
    })  # fmt: skip


def _panel() -> mi.Scene:
    return mi.load_dict({
        "type": "scene", "lamp": {"type": "rectangle", "emitter": {"type": "area"}},
        "spot": {"type": "point"},
    })  # fmt: skip


_LEARNERS = {
    "line": lambda: _learner(CameraMapLearner, Cells.line(6)),
    "square": lambda: _learner(CameraMapLearner, Cells.square(5)),
    "lamps": lambda: _learner(LightNumbersLearner, light_cells(_lamps(), 0)),
    "panel": lambda: _learner(LightNumbersLearner, light_cells(_panel(), 1)),
    "lobes": lambda: _learner(LobeMapLearner, lobe_cells(), 24),
}


@pytest.mark.parametrize("kind", _LEARNERS)
def test_arrays_hold_the_density_that_is_drawn_from(kind: str) -> None:
    learner = _LEARNERS[kind]()
    found = pixel_maps({"slot": learner}, _sensor(), 13, 7)["slot"]
    maps = found.density.reshape(learner.maps, *found.density.shape[-len(found.edges) :])
    u = np.random.default_rng(6).random((len(found.edges), 500)).astype(np.float32)
    places = tuple(np.searchsorted(e, x, "right") - 1 for e, x in zip(found.edges, u))
    cell = learner.cells.find([mi.Float(x) for x in u])
    for which in (0, learner.maps - 1):
        # Column 3 of the second row of tiles, of five
        table = mi.UInt32(np.full(500, 8 * learner.maps + which, np.uint32))
        expected = learner.decision.maps.density(table, cell)
        np.testing.assert_allclose(maps[which][places], expected.numpy(), rtol=1e-4)
    for axis in range(len(found.edges)):
        edges, density = found.along(axis)
        np.testing.assert_allclose((density * np.diff(edges)).sum(-1), 1, rtol=1e-4)
    assert found.tile == (12, 4, 16, 8)


def test_lights_have_the_probabilities_of_their_map() -> None:
    scene, learner = _lamps(), _LEARNERS["lamps"]()
    found = pixel_maps({"light_numbers": learner}, _sensor(), 0, 0)["light_numbers"]
    probability = light_probabilities(scene, found)
    # Cell i holds light i, and only the second has no probability
    np.testing.assert_allclose(probability, learner.decision.maps.mass[0, :5], rtol=1e-3)
    assert probability[1] == 0 and (probability[[0, 2, 3, 4]] > 0).all()


def test_pixels_of_a_film_with_a_border_are_numbered_as_in_the_image() -> None:
    film = {"sample_border": True, "rfilter": {"type": "gaussian"}}
    border = _sensor(**film).film().rfilter().border_size()
    assert border == 2
    learner = _learner(CameraMapLearner, Cells.line(2), border=border)
    found = pixel_maps({"time": learner}, _sensor(**film), 2, 0)["time"]
    # Column 2 is the fifth of the film's extent, behind the first tile
    np.testing.assert_allclose(found.density, 4 * learner.decision.maps.mass[1], rtol=1e-4)
    assert found.tile == (2, -2, 6, 2)


def test_unused_maps_are_missing_and_pixels_are_checked() -> None:
    learner = _LEARNERS["line"]()
    learner.decision.maps = None
    others = {"time": learner, "next_event": SimpleNamespace()}
    assert pixel_maps(others, _sensor(), 0, 0) == {}
    with pytest.raises(ValueError, match="20 x 12"):
        pixel_maps(others, _sensor(), 20, 0)


@pytest.mark.slow
def test_a_pixel_knows_when_a_ball_crosses_it() -> None:
    scene = load("six_balls", width=96, height=54)
    integrator = mi.load_dict({"type": "swarm_path", "max_depth": 2})
    mi.render(scene, integrator=integrator, spp=32)
    # The red ball is in (-0.4, 0, 0.6) in the middle of the shutter interval; other balls cross the
    # pixel at other times
    camera = scene.sensors()[0]
    x, y = np.meshgrid(np.arange(96), np.arange(54))
    position = mi.Point2f((x.ravel() + 0.5) / 96, (y.ravel() + 0.5) / 54)
    ray, _ = camera.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    towards = np.array([-0.4, 6, 0.6])
    pixel = int(np.argmax(towards @ ray.d.numpy().reshape(3, -1)))
    found = pixel_maps(integrator.learners, camera, pixel % 96, pixel // 96)["time"]
    middle = (found.edges[0] + 1 / 128)[:-1]
    crossing = np.abs(middle - 0.5) < 0.05
    assert found.density[crossing].mean() > 1.6 * found.density[~crossing].mean()
