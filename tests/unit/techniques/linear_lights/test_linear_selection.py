"""Choosing lights by their estimated contributions: unbiased, exact densities, no wrong zero."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.techniques.linear_lights.linear_lights import LinearChoice
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.walk import Walk
from tests.support.maps import connect
from tests.support.stage import area, diffuse, film, lookat, rectangle, rgb, sensor
from tests.support.statistical import REFERENCE_SEEDS, SEEDS, assert_same_mean, batches
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")

LANES = 1 << 16


def _integrator(max_depth: int) -> mi.Integrator:
    return mi.load_dict({"type": "composed_path", "max_depth": max_depth, "next_event": "linear"})


def _translate(*offset: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate(list(offset))


def _point(*position: float, intensity: float = 1.0, **changes) -> dict:
    return {
        "type": "point", "position": list(position), "intensity": rgb(intensity), **changes
    }


def _panel(*position: float, angle: float = 0.0, size: float = 0.3, radiance: float = 5.0) -> dict:
    """A rectangle that shines upwards, turned about the x axis."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], angle).scale(size)
    return rectangle(_translate(*position), turn, bsdf=diffuse(0.0), emitter=area(radiance))


def _mixed() -> dict:
    """All kinds of lights, some of them in and under a floor of rough glass."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "sensor": sensor(to_world=lookat([0, -4, 2], [0, 0, 0.3], [0, 0, 1])),
        "glass": rectangle(
            T().scale([1.5, 1.5, 1]),
            bsdf={"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.3},
        ),
        "ball": {
            "type": "sphere", "radius": 0.4, "to_world": _translate(0.5, 0, 0.5),
            "bsdf": {"type": "roughplastic", "diffuse_reflectance": rgb(0.5, 0.3, 0.2)},
        },
        "leaf": rectangle(
            _translate(-0.6, 0, 0.5), T().rotate([1, 0, 0], 70).scale(0.4),
            bsdf={"type": "principledthin", "base_color": rgb(0.3, 0.6, 0.2), "diff_trans": 1.2,
                  "roughness": 0.6, "spec_trans": 0.0},
        ),
        "wall": rectangle(
            _translate(0, 1.5, 1), T().rotate([1, 0, 0], 90).scale([2, 1.5, 1]),
            bsdf={"type": "twosided", "bsdf": diffuse()},
        ),
        "below": _panel(0, 0, -0.7),
        "globe": {
            "type": "sphere", "radius": 0.25, "to_world": _translate(-0.9, -0.5, 0.1),
            "emitter": area(2.0),
        },
        "lamp": _panel(0.3, -0.3, 2, angle=180),
        "point": _point(0.2, 0.3, -0.4, intensity=0.5),
        "spot": {
            "type": "spot", "intensity": rgb(4.0), "cutoff_angle": 30,
            "to_world": lookat([-1, -1, 2], [0, 0, 0], [0, 0, 1]),
        },
        "slide": {
            "type": "projector", "irradiance": rgb(1.0), "scale": 3.0, "fov": 30,
            "to_world": lookat([1, -1, 1.5], [0, 1, 0.5], [0, 0, 1]),
        },
        "sun": {"type": "directional", "direction": [0.3, 0.4, -1], "irradiance": rgb(0.5)},
        "sky": {"type": "constant", "radiance": rgb(0.2)},
    }  # fmt: skip


# ---- Unbiased ----


def test_mean_with_all_kinds_of_lights_and_glass_agrees_with_path():
    scene = mi.load_dict(_mixed())
    a = batches(scene, _integrator(4), 256, SEEDS[:8])
    b = batches(scene, REFERENCE.make(4), 256, REFERENCE_SEEDS)
    assert_same_mean(a, b, precision=0.015)


def test_mean_with_normal_maps_that_face_away_agrees_with_path():
    """Seen from below, some of the normals say that the surface is seen from above."""
    normal = np.full((4, 4, 3), [1.0, 0.5, 0.6])
    normal[::2] = [0.0, 0.5, 0.6]
    bsdf = {
        "type": "normalmap", "flip_invalid_normals": False, "bsdf": diffuse(),
        "normalmap": {
            "type": "bitmap", "raw": True, "bitmap": mi.Bitmap(normal.astype(np.float32))
        },
    }  # fmt: skip
    scene = mi.load_dict({
        "type": "scene",
        "sensor": sensor(to_world=lookat([0, -3, -0.5], [0, 0, 0], [0, 0, 1])),
        "floor": rectangle(bsdf=bsdf),
        "above": _point(0.3, 0, 0.7),
        "below": _point(-0.3, 0, -0.7),
    })
    a = batches(scene, _integrator(2), 512, SEEDS[:8])
    b = batches(scene, REFERENCE.make(2), 512, REFERENCE_SEEDS[:8])
    assert b.mean() > 1e-3
    assert_same_mean(a, b)


# ---- Densities ----


def _vertex(scene: mi.Scene, origin: list[float], target: list[float]) -> mi.SurfaceInteraction3f:
    """The same surface point in all lanes."""
    o, t = mi.Point3f(*origin), mi.Point3f(*target)
    # Data, not literals of kernels
    dr.make_opaque(o, t)
    o += dr.zeros(mi.Point3f, LANES)
    return scene.ray_intersect(mi.Ray3f(o, dr.normalize(t - o)))


def _select(scene: mi.Scene, si: mi.SurfaceInteraction3f):
    """One choice for each lane."""
    selection = LinearChoice(scene)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(7, LANES)
    ds, weight, _choice, state = connect(selection, scene, sampler, si)
    return selection, (ds, weight, state)


def _choices(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f
) -> dict[str, tuple[int, float]]:
    """How often each emitter was chosen, and with what probability according to ``ds.pdf``."""
    pdf = dr.select(ds.delta, 1, ds.emitter.pdf_direction(si, ds))
    α = dr.select(pdf > 0, ds.pdf / pdf, 0).numpy()
    chosen = dr.reinterpret_array(mi.UInt32, ds.emitter).numpy()
    choices = {}
    for emitter in scene.emitters():
        shape = emitter.get_shape()
        mine = α[chosen == dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter)).numpy()]
        probability = mine.max(initial=0)
        # There is no density where a light itself is in the way, or a projector shines elsewhere
        np.testing.assert_allclose(mine[mine > 0], probability, rtol=1e-3)
        choices[(shape or emitter).id()] = len(mine), probability
    return choices


def test_emitters_are_chosen_as_often_as_the_density_says():
    scene = mi.load_dict(_mixed())
    vertices = {
        "glass, from above": ([0.1, -2, 2], [0.1, -0.6, 0]),
        "from below": ([0.1, -0.2, -0.2], [0.2, -0.6, 0]),
        "wall": ([0, -2, 1], [0, 1.5, 1]),
        "ball": ([0.5, -2, 0.6], [0.5, 0, 0.5]),
    }
    for vertex in vertices.values():
        si = _vertex(scene, *vertex)
        selection, (ds, _weight, state) = _select(scene, si)
        choices = _choices(scene, si, ds)
        unknown = choices.pop("slide")[0] if choices["slide"][1] == 0 else 0
        counts, probabilities = (np.array(column) for column in zip(*choices.values()))
        error = 4 * np.sqrt(unknown) / LANES + 1e-4
        assert probabilities.sum() == pytest.approx(1 - unknown / LANES, abs=error), "Σ α"
        expected = probabilities * LANES
        frequent = expected > 5
        chi2 = ((counts - expected)[frequent] ** 2 / expected[frequent]).sum()
        assert stats.chi2.sf(chi2, frequent.sum()) > 1e-4, (counts, expected)

        # A ray that runs into what was chosen finds the same density
        hit = scene.ray_intersect(si.spawn_ray(ds.d))
        ds_hit = mi.DirectionSample3f(scene, hit, si)
        at_the_point = dr.norm(ds_hit.p - ds.p) < 1e-4
        at_the_point |= ds.emitter == scene.environment()
        same = ~ds.delta & (ds_hit.emitter == ds.emitter) & at_the_point
        pdf = selection.density(state, scene, mi.Interaction3f(si), hit, ds_hit, same)
        same = same.numpy()
        assert same.mean() > 0.05
        np.testing.assert_allclose(pdf.numpy()[same], ds.pdf.numpy()[same], rtol=2e-3)
        assert not pdf.numpy()[~same].any(), "masked lanes"


# ---- Zeros ----


def _floor(bsdf: dict, **lights) -> mi.Scene:
    return mi.load_dict({"type": "scene", "floor": rectangle(bsdf=bsdf), **lights})


def _counts(scene: mi.Scene, origin: tuple = (0.5, 0, 1)) -> dict[str, int]:
    """How often each emitter is chosen at the origin, seen from ``origin``."""
    si = _vertex(scene, list(origin), [0, 0, 0])
    _selection, (ds, _weight, _state) = _select(scene, si)
    return {name: count for name, (count, _α) in _choices(scene, si, ds).items()}


def test_a_sphere_whose_top_is_above_the_horizon_is_chosen():
    """The error that section 3.4.2 warns of."""
    sphere = {"type": "sphere", "radius": 1.0, "emitter": area(1.0)}
    scene = _floor(
        diffuse(),
        half=sphere | {"to_world": _translate(3, 0, -0.9)},
        under=sphere | {"to_world": _translate(0, 3, -1.5)},
        point=_point(0, 0, 1),
    )
    counts = _counts(scene)
    assert counts["half"] > 100 and counts["point"] > 100
    assert counts["under"] == 0


@pytest.mark.parametrize(
    "bsdf, is_opaque",
    [
        (lambda: diffuse(), True),
        (lambda: {"type": "twosided", "bsdf": {"type": "roughplastic"}}, True),
        (lambda: {"type": "roughdielectric"}, False),
        (lambda: {"type": "mask", "opacity": 0.5, "bsdf": diffuse()}, False),
        (lambda: {"type": "twosided", "bsdf": {"type": "bumpmap", "bsdf": diffuse(), "texture": {
            "type": "checkerboard"}}}, False),
    ],
)
def test_lights_below_the_horizon_are_chosen_where_they_can_contribute(bsdf, is_opaque):
    lights = {"above": _point(0, 0.5, 1), "below": _point(0, 0.5, -1)}
    counts = _counts(_floor(bsdf(), **lights))
    assert counts["above"] > 100
    assert (counts["below"] == 0) == is_opaque
    if bsdf()["type"] == "twosided" and is_opaque:
        counts = _counts(_floor(bsdf(), **lights), (0.5, 0, -1))
        assert counts["above"] == 0 and counts["below"] > 100, "seen from below"


def test_panels_that_shine_elsewhere_are_not_chosen():
    scene = _floor(
        diffuse(),
        away=_panel(0, 0, 1, radiance=1000.0),
        disk={
            "type": "disk", "to_world": _translate(0.5, 0, 2), "emitter": area(1000.0)
        },
        down=_panel(0, 1, 1, angle=180),
        # The vertex is behind its centre's horizon, but not behind its plane
        grazing=_panel(1, 0, 0.001, angle=90, size=0.5),
    )  # fmt: skip
    counts = _counts(scene)
    assert counts["away"] == 0 and counts["disk"] == 0
    assert counts["down"] > 100 and counts["grazing"] > 100


def test_a_light_that_nothing_faces_is_never_chosen_in_a_render():
    lamp = {"lamp": _panel(0, 0, 1, angle=180)}
    up = {"up": _panel(0, 0.5, 2, radiance=1e4)}
    camera = {"sensor": sensor(film=film(8, 8))}
    variances = []
    for lights in (lamp, lamp | up):
        scene = _floor(diffuse(), **camera, **lights)
        images = batches(scene, _integrator(2), 16, range(4))
        variances.append(np.var(images, axis=0).mean())
    # Choosing it would waste almost all samples
    assert variances[1] < 2 * variances[0]


def test_where_no_light_contributes_the_choice_is_uniform():
    lights = {f"p{i}": _point(i, 0, -1, intensity=1 + 10.0 * i) for i in range(4)}
    lights["off"] = _point(0, 1, -1, sampling_weight=0.0)
    counts = _counts(_floor(diffuse(), **lights))
    assert counts.pop("off") == 0
    np.testing.assert_allclose(list(counts.values()), LANES / 4, rtol=0.05)


def test_sampling_weight_is_a_factor():
    scene = _floor(
        diffuse(),
        three=_point(0, 0.5, 1, sampling_weight=3.0),
        one=_point(0, -0.5, 1),
        none=_point(0, 0, 0.5, sampling_weight=0.0),
    )
    counts = _counts(scene)
    assert counts["three"] / counts["one"] == pytest.approx(3, rel=0.05)
    assert counts["none"] == 0


# ---- Many, one, none ----


def test_a_thousand_lamps_estimate_the_sum_of_a_thousand_lamps():
    rng = np.random.default_rng(1)
    positions = rng.uniform([-2, -2, -1], [2, 2, 3], (1000, 3))
    intensities = 10 ** rng.uniform(-2, 2, 1000)
    scene = _floor(
        diffuse(),
        **{f"p{i:04}": _point(*p, intensity=w)
           for i, (p, w) in enumerate(zip(positions.tolist(), intensities.tolist()))},
    )  # fmt: skip
    si = _vertex(scene, [0.5, 0, 1], [0, 0, 0])
    _selection, (ds, weight, _state) = _select(scene, si)
    value = (weight.x * dr.maximum(si.to_local(ds.d).z, 0)).numpy().astype(np.float64)
    d2 = (positions**2).sum(axis=1)
    exact = (intensities * np.maximum(positions[:, 2], 0) / d2**1.5).sum()
    assert abs(value.mean() - exact) < 4 * value.std() / np.sqrt(LANES)
    # Nearly as good as the exact probabilities, which have no variance at all
    assert value.std() < 0.3 * exact


def test_one_emitter_needs_no_estimates_and_no_emitter_needs_no_tables():
    scene = _floor(diffuse(), lamp=_panel(0, 0, 1, angle=180))
    selection = LinearChoice(scene)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 4)
    assert selection.begin(sampler, mi.Ray3f()) is None
    image = batches(_floor(diffuse(), sensor=sensor(), lamp=_panel(0, 0, 1, angle=180)),
                    _integrator(3), 4, [1])  # fmt: skip
    assert image.mean() > 0
    dark = _floor(diffuse(), sensor=sensor())
    assert not batches(dark, _integrator(3), 4, [1]).any()


# ---- In the walk ----


class _Recording(LinearChoice):
    """Writes what it saw at each bounce into tables."""

    bounces = 4

    def __init__(self, scene: mi.Scene) -> None:
        super().__init__(scene)
        self.totals, self.distances = (dr.zeros(mi.Float, self.bounces) for _ in range(2))
        self.previous = dr.zeros(mi.Float, self.bounces)

    def begin(self, sampler, ray, pixel):
        return mi.UInt32(0), super().begin(sampler, ray, pixel)

    def visit(self, state, scene, si, active):
        bounce, before = state
        inside = active & (bounce < self.bounces)
        dr.scatter(self.previous, before.total, bounce, inside)
        place = super().visit(before, scene, si, active)
        dr.scatter(self.totals, place[0].total, bounce, inside)
        return bounce, place

    def sample(self, place, scene, numbers, si, active):
        bounce, place = place
        ds, weight, choice = super().sample(place, scene, numbers, si, active)
        dr.scatter(self.distances, ds.dist, bounce, active & (bounce < self.bounces))
        return ds, weight, choice

    def remember(self, place, *arguments):
        return place[0] + 1, super().remember(place[1], *arguments)

    def density(self, state, *arguments):
        return super().density(state[1], *arguments)


def test_each_bounce_sees_other_numbers_and_the_state_of_the_last():
    scene = mi.load_dict({
        "type": "scene",
        "box": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": diffuse(0.9)}},
        "a": _panel(0.2, 0, 0.9, angle=180),
        "b": {"type": "sphere", "radius": 0.1, "to_world": _translate(-0.5, 0.4, -0.2),
              "emitter": area(2.0)},
    })  # fmt: skip
    selection = _Recording(scene)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, 1)
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -0.5), dr.normalize(mi.Vector3f(0.3, 0.2, -1)))
    sample = Walk(selection.bounces + 1, 100, next_event=selection)(
        scene, sampler, CameraRays(ray), mi.Bool(True)
    )
    dr.eval(sample.L)
    totals, previous = selection.totals.numpy(), selection.previous.numpy()
    assert len(set(totals)) == selection.bounces and (totals > 0).all(), totals
    assert len(set(selection.distances.numpy())) == selection.bounces
    np.testing.assert_array_equal(previous, [0, *totals[:-1]])
