"""Guides in participating media: directions in space instead of primary samples."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.planning.pixel_estimates import PixelEstimates
from mitsuba_ext.scene.regions.surface_voxels import lit_normal
from mitsuba_ext.techniques.guided_directions.cells import cell_code
from mitsuba_ext.techniques.guided_directions.decisions import GuidedDirections
from mitsuba_ext.techniques.guided_directions.path_records import PathRecords, Samples
from mitsuba_ext.techniques.guided_directions.regions_with_media import RegionsWithMedia
from mitsuba_ext.techniques.guided_directions.sample_trees import SampleTrees
from mitsuba_ext.transport.media import direction_at, point_of
from mitsuba_ext.util.stored_arrays import StoredArrays
from tests.support.fogs import LIGHTS, camera, cube, fog, fog_around_the_camera, homogeneous
from tests.support.statistical import (
    REFERENCE_SEEDS,
    SEEDS,
    assert_images_are_sound,
    assert_same_pixels_on_average,
    batches,
    sidak,
    some,
    z_exact,
)

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 17

#: Pointers do not keep what they point to alive.
_media: list[mi.Medium] = []


class _Numbers:
    """A sampler."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def next_1d(self) -> mi.Float:
        return mi.Float(self._random.random(LANES, dtype=np.float32))

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(self._random.random((2, LANES), dtype=np.float32))


def _vertex(g: float, depth: int = 0) -> SimpleNamespace:
    """A vertex in a medium, reached by a path along an oblique direction."""
    _media.append(mi.load_dict(homogeneous(g=g)))
    mei, si = dr.zeros(mi.MediumInteraction3f), dr.zeros(mi.SurfaceInteraction3f, LANES)
    mei.wi = dr.normalize(mi.Vector3f(0.3, -0.5, 0.8))
    mei.sh_frame, mei.medium = mi.Frame3f(mei.wi), mi.MediumPtr(_media[-1])
    si.p, si.t = mi.Point3f(0.5), mi.Float(1)
    in_medium = SimpleNamespace(scatters=mi.Bool(True), mei=mei)
    return SimpleNamespace(si=si, medium=in_medium, depth=mi.UInt32(depth))


def _regions() -> RegionsWithMedia:
    """A floor, and a cube of fog above it, of which each half has places of its own."""
    random = np.random.default_rng(1)
    p = random.random((3, 4096))
    n = np.zeros((3, 4096))
    p[2, :2048], n[2, :2048] = 0, 1
    return RegionsWithMedia(mi.Point3f(p), mi.Normal3f(n), 32)


def _guide(regions: RegionsWithMedia, samples: Samples, share: float = 0.8) -> GuidedDirections:
    records = SimpleNamespace(region=samples.region, chosen=samples.chosen)
    nodes, roots, _ = regions.build(records)
    assert len(roots) == regions.tree_count
    arrays = nodes.probability, nodes.child, nodes.is_even, roots
    return GuidedDirections(SampleTrees(*arrays, dr.full(mi.Float, share, len(roots))), regions, 2)


def _samples(regions: RegionsWithMedia, vertex, d: mi.Vector3f, value, measure) -> Samples:
    zero, one = dr.zeros(mi.UInt32, LANES), dr.full(mi.Float, 1, LANES)
    return Samples(
        regions.label(vertex.si, None, mi.Bool(True)), cell_code(point_of(d)), zero, zero, value,
        one, one, one, zero, measure,
    )  # fmt: skip


def _from_phase(vertex, seed: int) -> tuple[mi.Vector3f, mi.Float]:
    """Directions that the phase function has sampled, and their densities."""
    numbers, mei = _Numbers(seed), vertex.medium.mei
    context, active = mi.PhaseFunctionContext(None), mi.Bool(True)
    phase = mei.medium.phase_function()
    d, _, pdf = phase.sample(context, mei, numbers.next_1d(), numbers.next_2d(), active)
    return d, pdf


def _light(d: mi.Vector3f) -> mi.Float:
    """From a window."""
    return dr.select((d.x > 0.5) & (d.y > 0.2), mi.Float(20), 1)


def _histogram(d: mi.Vector3f, weight: np.ndarray | None = None) -> np.ndarray:
    return np.bincount(cell_code(point_of(d)).numpy(), weight, 256)


@pytest.mark.parametrize("g", some(0.3, 0.95, of=[0.0, 0.3, 0.95, -0.95]))
def test_weighted_directions_have_the_density_of_the_phase_function(g: float) -> None:
    """In each cell of directions, and drawn more often where the light is."""
    regions, vertex = _regions(), _vertex(g)
    d, pdf = _from_phase(vertex, 1)
    samples = _samples(regions, vertex, d, _light(d), dr.inv_four_pi / pdf)
    guide = _guide(regions, samples)
    assert guide.gives_directions
    _, point, weight, _ = guide.draw(None, _Numbers(2), vertex, mi.Bool(True))
    guided, w = direction_at(point), weight.numpy()
    assert w.max() <= 5.001, "one in five directions is from the phase function"
    found, expected = _histogram(guided, w), _histogram(_from_phase(vertex, 3)[0])
    used = expected > 20
    error = np.sqrt(_histogram(guided, w**2) + expected)
    z = (found - expected)[used] / error[used]
    assert used.sum() > 8 and np.abs(z).max() < sidak(used.sum())
    share = (_light(guided) > 1).numpy().mean(), (_light(d) > 1).numpy().mean()
    assert share[0] > 1.2 * share[1]


def test_trees_of_media_have_the_density_of_what_directions_bring() -> None:
    """Where the light cancels the phase function, every direction brings as much, so that no cell
    is split, though the phase function finds few of them."""
    regions, vertex = _regions(), _vertex(0.5)
    d, pdf = _from_phase(vertex, 1)
    region = int(regions.label(vertex.si, None, mi.Bool(True)).numpy()[0])
    density = []
    for value in (1 / pdf, mi.Float(dr.select(d.z > 0, 1 / pdf, 0.05 / pdf))):
        guide = _guide(regions, _samples(regions, vertex, d, value, dr.inv_four_pi / pdf))
        density.append([
            float(guide.trees.density(mi.UInt32(region), point_of(mi.Vector3f(*x)), True)[0][0])
            for x in ((0.6, 0, 0.8), (0.6, 0, -0.8))
        ])  # fmt: skip
    np.testing.assert_allclose(density[0], 1)
    assert density[1][0] > 1.6 and density[1][1] < 0.4


def test_later_bounces_scatter_as_the_phase_function_says() -> None:
    regions, vertex = _regions(), _vertex(0.6)
    d, pdf = _from_phase(vertex, 1)
    samples = _samples(regions, vertex, d, _light(d), dr.inv_four_pi / pdf)
    late = _vertex(0.6, depth=2)
    _, point, weight, _ = _guide(regions, samples).draw(None, _Numbers(1), late, mi.Bool(True))
    assert (weight.numpy() == 1).all()
    np.testing.assert_allclose(direction_at(point).numpy(), d.numpy(), atol=2e-3)


def test_fog_and_floor_have_regions_of_their_own() -> None:
    regions = _regions()
    vertex = _vertex(0.3)
    in_fog = regions.label(vertex.si, None, mi.Bool(True)).numpy()
    floor = dr.zeros(mi.SurfaceInteraction3f, 2)
    floor.p, floor.n, floor.wi, floor.t = (
        mi.Point3f(0.5, 0.5, 0), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(1)
    )  # fmt: skip
    floor.sh_frame = mi.Frame3f(floor.n)
    shape = mi.load_dict({"type": "sphere", "bsdf": {"type": "diffuse"}})
    floor.shape = mi.ShapePtr(shape)
    assert (lit_normal(floor).z == 1).numpy().all()
    on_floor = regions.label(floor, None, mi.Bool(True)).numpy()
    first = regions._surfaces.tree_count
    assert (in_fog > first).all() and (0 < on_floor).all() and (on_floor < first).all()
    again = RegionsWithMedia(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1), 1)
    again.restore(StoredArrays.of(regions.state()))
    assert again.tree_count == regions.tree_count
    for si, expected in ((vertex.si, in_fog), (floor, on_floor)):
        assert (again.label(si, None, mi.Bool(True)).numpy() == expected).all()


def test_fog_without_any_vertex_is_not_guided() -> None:
    regions = RegionsWithMedia(mi.Point3f(0, 0, 0), mi.Normal3f(0, 0, 1), 1)
    vertex = _vertex(0.3)
    d, pdf = _from_phase(vertex, 1)
    samples = _samples(regions, vertex, d, _light(d), dr.inv_four_pi / pdf)
    samples.region = dr.zeros(mi.UInt32, LANES)
    guide = _guide(regions, samples)
    _, _, weight, _ = guide.draw(None, _Numbers(1), vertex, mi.Bool(True))
    assert (weight.numpy() == 1).all()


def test_records_remember_the_density_of_a_direction() -> None:
    vertex = _vertex(0.6)
    d, pdf = _from_phase(vertex, 1)
    records = PathRecords(lambda si, pixel, active: mi.UInt32(3), 1, 1, PixelEstimates(4, 4), True)
    records.begin(LANES, dr.zeros(mi.UInt32, LANES))
    records.direction(vertex, point_of(d), 1.0, mi.Color3f(0), mi.Bool(True))
    bs = dr.zeros(mi.BSDFSample3f)
    bs.pdf = pdf
    records.scattering(vertex, bs, mi.Bool(True))
    records.end(mi.Color3f(1))
    records.finish()
    np.testing.assert_allclose(records.measure, dr.inv_four_pi / pdf, rtol=1e-5)
    # Means over the square: the densities of all directions add up to one
    assert records.measure.numpy().mean() == pytest.approx(1, abs=0.02)


# ---- Renders ----


def _several() -> dict:
    return fog("area", inner=cube(homogeneous([3.0, 1.0, 0.5], 0.9, -0.5), 0.4,
                                  exterior=homogeneous()))  # fmt: skip


def _empty_cloud() -> dict:
    density = np.zeros((4, 4, 4, 1), dtype=np.float32)
    density[::2, 1:3, ::2] = 6.0
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(density),
              "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}  # fmt: skip
    return fog("area", {"type": "heterogeneous", "sigma_t": volume, "albedo": 0.9})


HARD = {
    "forward": lambda: fog("area", homogeneous(2.0, 0.9, 0.95)),
    "white": lambda: fog("area", homogeneous(3.0, 1.0)),
    "around_the_camera": lambda: fog_around_the_camera("area"),
    "empty_cloud": _empty_cloud,
    "several": _several,
    "lamp_inside": lambda: fog("area_inside", homogeneous(0.3, 0.9)),
    "coloured": lambda: fog("area", homogeneous([3.0, 1.0, 0.5], 0.9)),
    "dense": lambda: fog("area", homogeneous(40.0, 0.9)),
    "black": lambda: fog("area_inside", homogeneous(1.0, 0.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
def test_guided_fog_has_the_mean_of_volpath(name: str) -> None:
    scene = mi.load_dict(HARD[name]())
    integrator = mi.load_dict({"type": "pss_guided", "always_guide": True, "max_depth": 5})
    images = batches(scene, integrator, 512, SEEDS[:2])
    assert_images_are_sound(images)
    reference = mi.load_dict({"type": "volpath", "max_depth": 5})
    expected = batches(scene, reference, 1024, REFERENCE_SEEDS[:2])
    assert_same_pixels_on_average(images, expected, 0.03)


@pytest.mark.slow
def test_guided_white_fog_in_a_white_world_is_invisible() -> None:
    lamp = {**LIGHTS["point_inside"], "intensity": 1e-3}
    scene = mi.load_dict({"type": "scene", "sensor": camera(), "sky": {"type": "constant"},
                          "fog": cube(homogeneous(2.0, 1.0, 0.9)), "lamp": lamp})  # fmt: skip
    integrator = mi.load_dict({"type": "pss_guided", "always_guide": True, "max_depth": -1})
    images = batches(scene, integrator, 512, SEEDS[:8])
    z, error = z_exact(images.mean(axis=(1, 2, 3)), 1.0, allowance=1e-3)
    assert abs(z) < 4 and error < 0.004
