"""Choosing lights by a light tree: exact densities, probabilities that add up, no wrong zero."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.scene.lights.light_cells import LightCells
from mitsuba_ext.transport.light_table import OneRow
from mitsuba_ext.transport.tree_choice import TreeChoice, tree_choice
from tests.support.light_choices import (
    LANES,
    assert_density_fits,
    connect,
    counts_at,
    floor,
    mixed_lights,
    panel,
    point,
    select,
    translate,
    vertex_at,
)
from tests.support.stage import area, diffuse, lookat, rectangle, rgb, sensor
from tests.support.statistical import SEEDS, assert_same_mean, batches
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")


def _counts(scene: mi.Scene, *origin: tuple) -> dict[str, int]:
    return counts_at(tree_choice(scene), scene, *origin)


def _globe(x: float, y: float, z: float, radius: float = 0.3, **changes) -> dict:
    """A light of many triangles."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(0.3, np.pi - 0.3, 6))
    p = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1) * radius
    mesh = mi.Mesh("globe", 72, 120)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (p.reshape(-1, 3) + [x, y, z]).astype(np.float32).ravel()
    i, j = np.meshgrid(np.arange(12), np.arange(5))
    a, b = i + 12 * j, (i + 1) % 12 + 12 * j
    faces = np.stack([a, a + 12, b, b, a + 12, b + 12], -1).reshape(-1, 3)
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    path = changes.pop("path")
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "emitter": area(3.0), **changes}


# ---- Unbiased ----


@pytest.mark.parametrize("plugin, depth", [("composed_path", 4), ("bdpt", 3)])
def test_mean_with_all_kinds_of_lights_and_glass_agrees_with_path(plugin, depth):
    lights = mixed_lights()
    if plugin == "bdpt":
        lights.pop("slide")  # no light path leaves a projector
    scene = mi.load_dict(lights)
    tree = mi.load_dict({"type": plugin, "max_depth": depth, "next_event": "tree"})
    a = batches(scene, tree, 256, SEEDS[:6])
    b = batches(scene, REFERENCE.make(depth), 256, SEEDS[6:12])
    assert_same_mean(a, b, precision=0.02)


# ---- Densities ----


def test_emitters_are_chosen_as_often_as_the_density_says():
    scene = mi.load_dict(mixed_lights())
    assert_density_fits(tree_choice(scene), scene)


def _in_parts(scene: mi.Scene, *voxel: float) -> TreeChoice:
    """The choice among parts of lights, and bins of an environment."""
    return TreeChoice(scene, LightCells(scene, mi.Vector3f(*voxel)), OneRow())


def test_parts_are_chosen_as_often_as_the_density_says_and_none_that_lights_a_point_is_excluded():
    """Neither by the horizon of the point, nor by the directions in which the part shines."""
    scene = floor(
        diffuse(),
        window=panel(0.5, 0, 0.3, angle=100, size=1.5),
        tube={"type": "cylinder", "p0": [-1, -1, 0.4], "p1": [1, -1, 0.1], "radius": 0.2,
              "emitter": area(2.0)},
        box={"type": "cube", "to_world": translate(-0.7, 0.5, 0.3).scale(0.25),
             "emitter": area(2.0)},
        sky={"type": "constant", "radiance": rgb(0.1)},
    )  # fmt: skip
    selection = _in_parts(scene, 0.2, 0.2, 0.2)
    cells, count = selection.cells, 64
    assert cells.first_bin > 40 and cells.bins.count == 512
    index = dr.arange(mi.UInt32, cells.count * count)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(index))
    for place in ([0.2, 0.1, 0], [-0.4, 0.3, 0], [0.9, -0.6, 0]):
        si = vertex_at(scene, [place[0], place[1], 0.01], place)
        probability = _probabilities(selection, scene, si)
        assert probability.sum() == pytest.approx(1, abs=1e-4)
        numbers = mi.load_dict({"type": "independent"})
        numbers.seed(7, LANES)
        choice = connect(selection, scene, numbers, si)[2]
        np.testing.assert_allclose(
            choice.probability.numpy(), probability[choice.cell.numpy()], rtol=1e-3
        )
        counts = np.bincount(choice.cell.numpy(), minlength=cells.count)
        expected = LANES * probability
        frequent = expected > 5
        chi2 = ((counts - expected)[frequent] ** 2 / expected[frequent]).sum()
        assert stats.chi2.sf(chi2, frequent.sum()) > 1e-4 and not counts[expected == 0].any()
        si = dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, len(index)))
        ds, weight = cells.sample(index // count, si, sampler.next_2d(), mi.Bool(True))
        shines = (dr.max(weight) > 0) & (dr.dot(ds.d, si.n) > 0)
        shines = shines.numpy().reshape(-1, count).any(axis=1)
        assert 0.3 < shines.mean() < 0.95
        assert (probability[shines] > 0).all()


def _probabilities(selection: TreeChoice, scene: mi.Scene, si: mi.SurfaceInteraction3f):
    """The probability of each cell at a point."""
    cell = dr.arange(mi.UInt32, selection.cells.count)
    si = dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, len(cell)))
    place = selection.visit(selection.begin(None, None), scene, si, mi.Bool(True))
    return selection.of_cell(cell, place, si, mi.Bool(True)).numpy()


def test_faces_of_a_mesh_are_chosen_as_often_as_the_density_says(tmp_path):
    globe = _globe(0, 0, 1, path=tmp_path / "globe.ply")
    scene = floor(diffuse(), globe=globe, lamp=panel(0.5, 0, 2, angle=180))
    selection = tree_choice(scene)
    assert selection.cells.count == 121
    si = vertex_at(scene, [0.5, -2, 1], [0.3, 0.1, 0])
    probability = _probabilities(selection, scene, si)
    assert probability.sum() == pytest.approx(1, abs=1e-5)
    # The faces on the upper side
    assert (probability[:120] == 0).sum() > 30
    ds, _weight, state = select(selection, scene, si)
    hit = scene.ray_intersect(si.spawn_ray(ds.d))
    ds_hit = mi.DirectionSample3f(scene, hit, si)
    same = (dr.norm(ds_hit.p - ds.p) < 1e-4) & (ds.emitter == ds_hit.emitter)
    pdf = selection.density(state, scene, mi.Interaction3f(si), hit, ds_hit, same)
    cell, of_cell = selection.cells.pdf(mi.Interaction3f(si), hit, ds_hit, same)
    pdf, of_cell, cell, same = (x.numpy() for x in (pdf, of_cell, cell, same))
    assert same.mean() > 0.3 and not pdf[~same].any()
    # Points near an edge may belong to the neighbour that the ray hits
    different = np.abs(pdf - ds.pdf.numpy())[same] > 2e-3 * ds.pdf.numpy()[same]
    assert different.mean() < 0.005
    np.testing.assert_allclose(pdf[same], (of_cell * probability[cell])[same], rtol=2e-3)
    # Each face is hit as often as its probability says, where all of the face is visible
    counts = np.bincount(cell[same], minlength=121)
    assert (counts <= probability * LANES + 6 * np.sqrt(probability * LANES) + 1).all()
    seen = (probability > 1e-3) & (counts > 0.9 * probability * LANES)
    assert seen.sum() > 20


def test_probabilities_add_up_to_one_everywhere():
    """Also where all lights are dark, and with lights of the weight 0."""
    rng = np.random.default_rng(3)
    lamps = {
        f"p{i:03}": panel(*rng.uniform(-2, 2, 3), angle=rng.uniform(0, 360), size=0.02,
                          radiance=10 ** rng.uniform(-3, 3))
        for i in range(200)
    }  # fmt: skip
    off = point(0, 0, 1, sampling_weight=0.0)
    scene = floor(diffuse(), off=off, **lamps, sky={"type": "constant", "radiance": rgb(0.1)})
    selection = tree_choice(scene)
    for target in ([0, 0, 0], [0.7, 0.3, 0], [-0.9, -0.9, 0]):
        probability = _probabilities(selection, scene, vertex_at(scene, [0, 0.1, 3], target))
        assert (probability >= 0).all()
        assert probability.sum() == pytest.approx(1, abs=1e-5)
        assert (probability == 0).sum() > 20, "some shine elsewhere"
    below = floor(diffuse(), **{f"p{i}": point(0.1 * i, 0, -1) for i in range(50)})
    selection = tree_choice(below)
    probability = _probabilities(selection, below, vertex_at(below, [0, 0, 1], [0, 0, 0]))
    assert probability.sum() == pytest.approx(1, abs=1e-5) and (probability > 0).all()


def test_textured_meshes_and_meshes_of_few_faces_are_whole():
    cube = {"type": "cube", "to_world": translate(0, 0, 3), "emitter": area(1.0)}
    scene = floor(diffuse(), lamp=panel(0, 0, 2, angle=180), cube=cube)
    assert tree_choice(scene).cells.count == 13
    texture = {"type": "area", "radiance": {"type": "checkerboard"}}
    scene = floor(diffuse(), lamp=panel(0, 0, 2, angle=180), cube=cube | {"emitter": texture})
    assert tree_choice(scene).cells.count == 2


# ---- Zeros ----


def test_a_sphere_whose_top_is_above_the_horizon_is_chosen():
    sphere = {"type": "sphere", "radius": 1.0, "emitter": area(1.0)}
    scene = floor(
        diffuse(),
        half=sphere | {"to_world": translate(3, 0, -0.9)},
        under=sphere | {"to_world": translate(0, 3, -1.5)},
        point=point(0, 0, 1),
    )
    counts = _counts(scene)
    assert counts["half"] > 100 and counts["point"] > 100
    assert counts["under"] == 0


@pytest.mark.parametrize(
    "bsdf, is_opaque",
    [
        (lambda: diffuse(), True),
        (lambda: {"type": "roughdielectric"}, False),
        (lambda: {"type": "twosided", "bsdf": {"type": "bumpmap", "bsdf": diffuse(), "texture": {
            "type": "checkerboard"}}}, False),
    ],
)  # fmt: skip
def test_lights_below_the_horizon_are_chosen_where_they_can_contribute(bsdf, is_opaque):
    lights = {"above": point(0, 0.5, 1), "below": point(0, 0.5, -1)}
    counts = _counts(floor(bsdf(), **lights))
    assert counts["above"] > 100
    assert (counts["below"] == 0) == is_opaque


def test_lights_that_shine_elsewhere_are_not_chosen():
    spot = {"type": "spot", "cutoff_angle": 20, "intensity": rgb(10.0)}
    scene = floor(
        diffuse(),
        away=panel(0, 0, 1, radiance=1000.0),
        disk={"type": "disk", "to_world": translate(0.5, 0, 2), "emitter": area(1000.0)},
        down=panel(0, 1, 1, angle=180),
        by_angle=panel(0, 0, 1) | {"emitter": area(1000.0) | {"type": "solid_angle_area"}},
        # The vertex is behind its centre's horizon, but not behind its plane
        grazing=panel(1, 0, 0.001, angle=90, size=0.5),
        beside=spot | {"to_world": lookat([0, 0, 2], [0.9, 0, 0], [0, 1, 0])},
        at=spot | {"to_world": lookat([0, 0, 2], [0.6, 0, 0], [0, 1, 0])},
    )  # fmt: skip
    counts = _counts(scene)
    assert counts["away"] == 0 and counts["disk"] == 0 and counts["beside"] == 0
    assert counts["by_angle"] == 0
    assert counts["down"] > 10 and counts["grazing"] > 10 and counts["at"] > 100


# ---- One, none ----


def test_one_emitter_and_no_emitter_need_no_tree():
    assert tree_choice(floor(diffuse(), lamp=panel(0, 0, 1, angle=180))) is None
    assert tree_choice(floor(diffuse())) is None


def test_vertices_in_a_medium_have_no_horizon():
    fog = {
        "type": "cube", "bsdf": {"type": "null"},
        "interior": {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.8},
    }  # fmt: skip
    scene = mi.load_dict({
        "type": "scene", "sensor": sensor(to_world=lookat([0, -4, 1], [0, 0, 0], [0, 0, 1])),
        "fog": fog, "floor": rectangle(translate(0, 0, -0.5), bsdf=diffuse()),
        **{f"p{i}": point(0.5 * i - 1, 1.5 * (-1) ** i, 0.3 * i) for i in range(5)},
    })  # fmt: skip
    # Else camera paths and light paths would disagree on the probabilities
    point_in_fog, choice = dr.zeros(mi.SurfaceInteraction3f, 2), tree_choice(scene)
    point_in_fog.wi, point_in_fog.sh_frame = [0, 0, 1], mi.Frame3f([[0, 1], [0, 0], [1, 0]])
    place = choice.visit(choice.begin(None, None), scene, point_in_fog, mi.Bool(True))
    first, second = choice.of_cell(mi.UInt32(1), place, mi.Interaction3f(point_in_fog), True)
    assert first == second
    tree = mi.load_dict({"type": "composed_path", "max_depth": 4, "next_event": "tree"})
    uniform = mi.load_dict({"type": "composed_path", "max_depth": 4})
    a, b = (batches(scene, each, 128, SEEDS[i : i + 4]) for i, each in ((0, tree), (4, uniform)))
    assert_same_mean(a, b, precision=0.03)


def test_all_cells_keep_their_numbers():
    """Cells of lights that are never chosen are cells, too."""
    lights = {f"p{i}": point(0, 0, 1 + i, sampling_weight=i % 2) for i in range(4)}
    scene = floor(diffuse(), **lights)
    selection = TreeChoice(scene, LightCells(scene, None))
    probability = _probabilities(selection, scene, vertex_at(scene, [0.5, 0, 1], [0, 0, 0]))
    weights = np.array([e.sampling_weight() for e in scene.emitters()])
    np.testing.assert_array_equal(probability > 0, weights > 0)
