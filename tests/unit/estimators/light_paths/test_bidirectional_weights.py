"""The weights of all techniques that find a path add up to 1 and follow from the densities."""

from __future__ import annotations

import gc
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.both_ends import FromBothEnds, from_both_ends
from mitsuba_ext.estimators.light_paths.emission import LightEmission
from mitsuba_ext.estimators.light_paths.lens import connectable
from mitsuba_ext.estimators.light_paths.sensor import ConnectableSensor
from mitsuba_ext.estimators.light_paths.subpath_choice.region_table import RegionTable
from mitsuba_ext.planning.technique import Setting
from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.scene.regions.nested_regions import NestedRegions
from mitsuba_ext.scene.regions.surface_voxels import SurfaceRows
from mitsuba_ext.transport.light_table import LightTable, sampling_weights
from mitsuba_ext.transport.path_decisions import EmitterSampling, SubpathSelection
from tests.support import fogs
from tests.support.bidirectional_paths import (
    CONNECTIONS,
    LIGHT_PATHS,
    Paths,
    trace,
    trace_in_medium,
    weights_of_techniques,
)
from tests.support.emitters_and_materials import EMITTERS, MATERIALS, SPECULAR, T, stage_with_ball
from tests.support.stage import area, diffuse, octahedron, rectangle, rgb, sensor, stage
from tests.support.statistical import some

pytestmark = pytest.mark.usefixtures("variant")


@pytest.fixture(autouse=True)
def no_scene_of_an_earlier_test() -> None:
    """Garbage is collected at times that depend on what was imported. Where scenes of earlier tests
    were still in memory, Dr.Jit once defined a function of a kernel twice."""
    gc.collect()


def weights(
    scene: mi.Scene,
    light: int,
    camera: int,
    next_event: EmitterSampling | None = None,
    selection: SubpathSelection | None = None,
) -> tuple[np.ndarray, np.ndarray, Paths, LightEmission]:
    """Weights of paths with these numbers of vertices: [s, path] for the paths that exist."""
    found, exists, _, paths, emission = weights_and_ratios(
        scene, light, camera, next_event, selection
    )
    return found[:, exists], exists, paths, emission


def weights_and_ratios(
    scene: mi.Scene,
    light: int,
    camera: int,
    next_event: EmitterSampling | None = None,
    selection: SubpathSelection | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Paths, LightEmission]:
    """What :func:`weights_of_techniques` returns, of such paths, the paths, and the emission."""
    emission, eye = LightEmission(scene), scene.sensors()[0]
    target = connectable(eye) if ConnectableSensor.can_connect(eye) else None
    paths = trace(scene, emission, eye, light, camera)
    found = weights_of_techniques(
        scene, paths, emission, target, next_event or EmitterSampling(), selection
    )
    return *found, paths, emission


def assert_they_add_up(
    found: np.ndarray, close: float = 2e-3, share: float = 0.99, at_least: int = 20
) -> None:
    """Rounding: rays leave a light a little above it, and cosines may be small."""
    error = np.abs(found.sum(axis=0) - 1)
    assert len(error) >= at_least
    assert np.median(error) < 1e-3 * max(1, close / 2e-3)
    assert (error < close).mean() >= share, np.sort(error)[-5:]


#: Numbers of vertices next to the light, and to the camera: paths of 2, 3, 4 segments.
SHAPES = ((1, 0), (2, 0), (1, 2))


@pytest.mark.parametrize("name", some("rectangle", "mirrored cube", "constant", of=EMITTERS))
def test_weights_of_an_emitter_add_up(name: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[name]()), optimize=False)
    for light, camera in SHAPES:
        # Texels have edges
        close = 1e-2 if "textured" in name else 2e-3
        assert_they_add_up(weights(scene, light, camera)[0], close, 0.98)


@pytest.mark.parametrize("changes", [
    {"plugin": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.0},
    {"plugin": "orthographic"},
    {"principal_point_offset_x": 0.2, "near_clip": 1.0},
], ids=["thinlens", "orthographic", "shifted"])  # fmt: skip
def test_weights_of_a_sensor_add_up(changes: dict[str, Any]) -> None:
    scene = mi.load_dict(stage(camera=sensor(**changes)), optimize=False)
    for shape in ((1, 0), (1, 1)):
        assert_they_add_up(weights(scene, *shape)[0])


@pytest.mark.parametrize("name", some("glass", of=[*MATERIALS, *SPECULAR]))
def test_weights_of_a_material_add_up(name: str) -> None:
    scene = mi.load_dict(stage_with_ball({**MATERIALS, **SPECULAR}[name]()), optimize=False)
    for light, camera in ((2, 1), (1, 2)):
        assert_they_add_up(weights(scene, light, camera)[0])


def test_weights_of_a_lamp_with_interpolated_normals_add_up() -> None:
    lamp = octahedron(0.3, (-0.3, 0, 1.5), bsdf=diffuse(0), emitter=area(5.0))
    scene = mi.load_dict(stage(light=lamp), optimize=False)
    assert_they_add_up(weights(scene, 1, 0, sampling_weights(scene))[0])


def _lights() -> dict[str, Any]:
    return {
        "point": {"type": "point", "position": [0.8, -1, 1.5], "intensity": rgb(1.0)},
        "sky": {"type": "constant"},
    }


@pytest.mark.parametrize("choice", some("spatial", of=["power", "spatial", "linear"]))
def test_weights_of_a_choice_of_lights_add_up(choice: str) -> None:
    scene = mi.load_dict(stage(**_lights()), optimize=False)
    plugin = mi.load_dict({"type": "bdpt", "next_event": choice})
    setting = Setting(scene, scene.sensors()[0], 16, 4, 5, 1)
    decision = FromBothEnds(plugin.slots["next_event"].decision(setting))
    for light, camera in ((1, 0), (1, 1)):
        assert_they_add_up(weights(scene, light, camera, decision)[0])


@pytest.mark.parametrize(
    "bsdf", some("rough glass", of=["rough glass", "twosided plastic", "normalmap", "principled"])
)
def test_both_ends_agree_on_rows_that_tell_sides_of_surfaces(bsdf: str) -> None:
    """A pane between the lamps and the floor."""
    pane = rectangle(T().translate([0, 0, 0.9]).rotate([1, 0, 0], 25), bsdf=MATERIALS[bsdf]())
    scene = mi.load_dict(stage(pane=pane, **_lights()), optimize=False)
    found, exists, paths, _ = weights(scene, 1, 1)
    first = paths.vertices[0].from_light
    p, n = (np.array(v)[:, exists] for v in (first.p, first.n))
    p, n = np.concatenate([p, p], axis=1), np.concatenate([n, -n], axis=1)
    rows = SurfaceRows(scene.bbox(), 4, mi.Point3f(p), mi.Normal3f(n))
    cells = LightCells(scene, None)
    likes = np.random.default_rng(5).uniform(0.01, 1, rows.count * cells.count) ** 3
    table = LightTable(rows, cells, mi.Float(likes.astype(np.float32)))
    assert_they_add_up(weights(scene, 1, 1, FromBothEnds(table))[0])


def any_table(*paths: Paths) -> RegionTable:
    """Regions where these paths have vertices, on both sides of surfaces, and any probabilities."""
    vertices = [v for each in paths for v in each.vertices]
    p, n = (np.concatenate([np.array(getattr(v, a)) for v in vertices], axis=1) for a in "pn")
    p, n = np.concatenate([p, p], axis=1), np.concatenate([n, -n], axis=1)
    regions = NestedRegions(mi.Point3f(p), mi.Normal3f(n), most=60)
    rng = np.random.default_rng(3)
    probability = rng.uniform(0.01, 1, (regions.count, regions.count)) ** 3
    probability /= probability.sum(axis=1, keepdims=True)
    return RegionTable(regions, probability, rng.uniform(0.01, 0.2, regions.count))


@pytest.mark.parametrize(
    "bsdf", some("rough glass", of=["rough glass", "twosided plastic", "normalmap", "principled"])
)
def test_weights_of_light_vertices_that_are_chosen_by_regions_add_up(bsdf: str) -> None:
    pane = rectangle(T().translate([0, 0, 0.9]).rotate([1, 0, 0], 25), bsdf=MATERIALS[bsdf]())
    scene = mi.load_dict(stage(pane=pane, **_lights()), optimize=False)
    selection = any_table(*(weights(scene, *shape)[2] for shape in ((2, 1), (1, 2))))
    for light, camera in ((1, 1), (2, 1), (1, 2)):
        assert_they_add_up(weights(scene, light, camera, selection=selection)[0])


@pytest.mark.parametrize("merging", ["all", "caustics"])
@pytest.mark.parametrize("name", some("mirror", of=["rough glass", "glass", "mirror"]))
def test_weights_with_merging_add_up(merging: str, name: str) -> None:
    """The weights of merging come last: one for each vertex."""
    scene = mi.load_dict(stage_with_ball({**MATERIALS, **SPECULAR}[name]()), optimize=False)
    emission, eye = LightEmission(scene), scene.sensors()[0]
    shares = []
    for light, camera in ((2, 1), (1, 2)):
        paths = trace(scene, emission, eye, light, camera)
        found, exists, _ = weights_of_techniques(
            scene, paths, emission, ConnectableSensor(eye), EmitterSampling(), merging=merging
        )
        assert_they_add_up(found[:, exists])
        shares.append(found[light + camera + 2 :, exists].sum(axis=0).max())
    assert max(shares) > 0.1 or (merging, name) == ("caustics", "rough glass")


@pytest.mark.parametrize("merging", some("all", of=[None, "all"]))
@pytest.mark.parametrize("light", some("area", "environment", of=fogs.LIGHTS))
def test_weights_of_paths_in_a_medium_add_up(light: str, merging: str | None) -> None:
    """For any transmittances of the segments."""
    scene = mi.load_dict({
        "type": "scene", "light": fogs.LIGHTS[light],
        "sensor": fogs.camera(medium=fogs.homogeneous([0.5, 1.0, 3.0], g=0.5)),
    })  # fmt: skip
    emission, eye = LightEmission(scene), scene.sensors()[0]
    for count in (1, 2, 3):
        paths = trace_in_medium(scene, emission, eye, count)
        found, exists, _ = weights_of_techniques(
            scene, paths, emission, ConnectableSensor(eye), EmitterSampling(), merging=merging
        )
        assert_they_add_up(found[:, exists])
        assert merging is None or found[count + 2 :, exists].max() > 0.1


# ---- Densities with which camera paths find what light paths find ----


def assert_camera_ratios(
    scene: mi.Scene, light: int, camera: int, selection: SubpathSelection | None = None
) -> None:
    """Light paths know the densities of the first two techniques, in units of their own: the roots
    of the ratios of the weights."""
    found, exists, ratios, _, _ = weights_and_ratios(scene, light, camera, selection=selection)
    found, ratios = found[:, exists], ratios[..., exists]
    assert len(ratios) == len(found) - 2
    compared = 0
    for s, (own, ratio) in enumerate(zip(found[2:], ratios), 2):
        assert_kinds(found, s, ratio[2:])
        for by_camera, q in zip(found[:2], ratio):
            # What camera paths cannot find, or so rarely that its weight is below the least float
            assert np.all((own * q**2)[(by_camera == 0) & (own > 0)] < 1e-30)
            is_clear = (own > 1e-3) & (by_camera > 1e-3)
            if is_clear.any():
                expected = np.sqrt(by_camera[is_clear] / own[is_clear])
                assert np.quantile(np.abs(q[is_clear] / expected - 1), 0.98) < 1e-2
            compared += is_clear.sum()
    assert compared >= 20


def assert_kinds(found: np.ndarray, s: int, squares: np.ndarray) -> None:
    """``squares``: the squares for the other connections, and for the light image, of technique
    s."""
    own, last = found[s], len(found) - 1
    others = [k for k in range(2, last) if k != s], [last] if s != last else []
    is_clear = own > 1e-3
    for kind, q2 in zip(others, squares):
        expected = found[kind].sum(axis=0)[is_clear] / own[is_clear]
        np.testing.assert_allclose(q2[is_clear], expected, rtol=3e-2, atol=1e-3)


@pytest.mark.parametrize("name", some("rectangle", "constant", of=EMITTERS))
def test_light_paths_know_how_camera_paths_find_an_emitter(name: str) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[name]()), optimize=False)
    for shape in SHAPES:
        assert_camera_ratios(scene, *shape)


@pytest.mark.parametrize("name", some("glass", "mask", of=[*MATERIALS, *SPECULAR]))
def test_light_paths_know_how_camera_paths_find_light_by_way_of_a_material(name: str) -> None:
    """A sky: camera paths that meet a mirror or glass run into it."""
    scene = {**stage_with_ball({**MATERIALS, **SPECULAR}[name]()), "light": EMITTERS["constant"]()}
    scene = mi.load_dict(scene, optimize=False)
    for shape in ((2, 1), (3, 1), (1, 2)):
        assert_camera_ratios(scene, *shape)


def test_ratios_of_camera_paths_count_connections_that_are_chosen_by_regions() -> None:
    scene = mi.load_dict(stage(**_lights()), optimize=False)
    selection = any_table(*(weights(scene, *shape)[2] for shape in ((2, 1), (1, 2))))
    for shape in ((1, 1), (2, 1), (1, 2)):
        assert_camera_ratios(scene, *shape, selection)


# ---- Densities of diffuse paths, computed once more ----


def _densities(name: str, paths: Paths, exists: np.ndarray, scene: mi.Scene) -> np.ndarray:
    """The density of each technique, in common units: [s, path]."""
    emitted, eye = paths.emitted, ConnectableSensor(scene.sensors()[0])
    p, n = ([np.array(getattr(v, a), dtype=np.float64)[:, exists] for v in paths.vertices]
            for a in "pn")  # fmt: skip
    start, normal, d = (
        np.array(v, dtype=np.float64)[:, exists]
        for v in (emitted.start.p, emitted.start.n, emitted.ray.d)
    )
    near = np.array(eye.origin(paths.camera_ray)[0], dtype=np.float64)
    origin = np.broadcast_to(near.reshape(3, -1), (3, len(exists)))[:, exists]

    def to(a, b, n):
        """Square of the distance, and the cosine at b."""
        v = b - a
        d2 = (v**2).sum(axis=0)
        return d2, np.abs((v * n).sum(axis=0)) / np.sqrt(d2)

    def cosine(v, n):
        return np.abs((v * n).sum(axis=0))

    def scatters(a, n, b, n_b):
        """Density of b per area, if a diffuse surface at a chooses the direction."""
        d2, arrives = to(a, b, n_b)
        return to(b, a, n)[1] / np.pi * arrives / d2

    # The camera: uniform on the image, whose area at the distance 1 is this
    area = (2 * np.tan(np.radians(45.0) / 2)) ** 2
    axis = np.array([0, 4, -0.6]) / np.hypot(4, 0.6)
    d2, arrives = to(origin, p[-1], n[-1])
    on_axis = ((p[-1] - origin) * axis[:, None]).sum(axis=0) / np.sqrt(d2)
    camera = [np.ones_like(d2), arrives / d2 / (area * on_axis**3)]
    for i in range(len(p) - 1, 0, -1):
        camera.append(camera[-1] * scatters(p[i], n[i], p[i - 1], n[i - 1]))
    # camera[t]: density of the t vertices next to it
    infinite = name in ("directional", "constant")
    d2, arrives = to(start, p[0], n[0])
    if infinite:
        d2, arrives = np.ones_like(d2), cosine(d, n[0])
    leaves_0 = 1 if infinite or name == "point" else cosine(d, normal)
    radius = 1.001 * float(scene.bbox().bounding_sphere().radius)
    by_bsdf = cosine(d, n[0]) / np.pi * leaves_0 / d2
    # Of the light's point by a connection, of that point by emission, of the direction
    point, start_pdf, direction, hit = {
        "rectangle": lambda: (1 / 0.64, 1 / 0.64, leaves_0 / np.pi, by_bsdf),
        "point": lambda: (1, 1, 1 / (4 * np.pi), 0 * d2),
        "directional": lambda: (1, 1 / (np.pi * radius**2), 1, 0 * d2),
        "constant": lambda: (
            1 / (4 * np.pi), 1 / (np.pi * radius**2), 1 / (4 * np.pi), by_bsdf,
        ),
    }[name]()  # fmt: skip
    light = [start_pdf * direction * arrives / d2]
    for i in range(len(p) - 1):
        light.append(light[-1] * scatters(p[i], n[i], p[i + 1], n[i + 1]))
    # s = 0, 1, 2, …: of all k − 1 vertices on surfaces, and of the light's point
    count = len(p)
    return np.stack(
        [camera[count] * hit, camera[count] * point]
        + [light[s - 2] * camera[count + 1 - s] for s in range(2, count + 2)]
    )


@pytest.mark.parametrize("by_regions", [False, True])
@pytest.mark.parametrize(
    "name", some("rectangle", "constant", of=["rectangle", "point", "directional", "constant"])
)
def test_weights_follow_from_the_densities(name: str, by_regions: bool) -> None:
    scene = mi.load_dict(stage(light=EMITTERS[name]()), optimize=False)
    selection = any_table(weights(scene, 1, 2)[2]) if by_regions else None
    for light, camera in SHAPES:
        found, exists, paths, _ = weights(scene, light, camera, selection=selection)
        densities = _densities(name, paths, exists, scene)
        # Except for hits (0), connections to lights (1) and to the sensor (the last)
        densities[2:-1] *= CONNECTIONS
        densities[-1] *= LIGHT_PATHS
        if selection is not None:
            # Technique s connects the vertices s − 2 and s − 1
            vertices = paths.vertices
            for s, (a, b) in enumerate(zip(vertices, vertices[1:]), start=2):
                ends = (from_both_ends(si) for si in (b.from_camera, a.from_light))
                regions = (selection.region(si, mi.Bool(True)) for si in ends)
                expected = np.array(selection.expected(*regions, mi.Bool(True)))
                densities[s] *= expected[exists]
        squares = densities**2
        error = np.abs(found - squares / squares.sum(axis=0))
        assert np.median(error) < 1e-4
        assert np.quantile(error, 0.99) < 5e-3, (light, camera, error.max(axis=1))
