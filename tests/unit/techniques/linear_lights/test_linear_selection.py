"""Choosing lights by their estimated contributions: unbiased, exact densities, no wrong zero."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.techniques.linear_lights.linear_lights import LinearChoice
from mitsuba_ext.transport.estimator import CameraRays
from mitsuba_ext.transport.walk import Walk
from tests.support.light_choices import (
    LANES,
    assert_density_fits,
    counts_at,
    floor,
    mixed_lights,
    panel,
    point,
    translate,
)  # fmt: skip
from tests.support.stage import area, diffuse, film, lookat, rectangle, sensor
from tests.support.statistical import REFERENCE_SEEDS, SEEDS, assert_same_mean, batches
from tests.support.techniques import REFERENCE

pytestmark = pytest.mark.usefixtures("variant")


def _integrator(max_depth: int) -> mi.Integrator:
    return mi.load_dict({"type": "composed_path", "max_depth": max_depth, "next_event": "linear"})


# ---- Unbiased ----


def test_mean_with_all_kinds_of_lights_and_glass_agrees_with_path():
    scene = mi.load_dict(mixed_lights())
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
        "above": point(0.3, 0, 0.7),
        "below": point(-0.3, 0, -0.7),
    })
    a = batches(scene, _integrator(2), 512, SEEDS[:8])
    b = batches(scene, REFERENCE.make(2), 512, REFERENCE_SEEDS[:8])
    assert b.mean() > 1e-3
    assert_same_mean(a, b)


# ---- Densities ----


def test_emitters_are_chosen_as_often_as_the_density_says():
    scene = mi.load_dict(mixed_lights())
    assert_density_fits(LinearChoice(scene), scene)


# ---- Zeros ----


def _counts(scene: mi.Scene, *origin: tuple) -> dict[str, int]:
    return counts_at(LinearChoice(scene), scene, *origin)


def test_a_sphere_whose_top_is_above_the_horizon_is_chosen():
    """The error that section 3.4.2 warns of."""
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
        (lambda: {"type": "twosided", "bsdf": {"type": "roughplastic"}}, True),
        (lambda: {"type": "roughdielectric"}, False),
        (lambda: {"type": "mask", "opacity": 0.5, "bsdf": diffuse()}, False),
        (lambda: {"type": "twosided", "bsdf": {"type": "bumpmap", "bsdf": diffuse(), "texture": {
            "type": "checkerboard"}}}, False),
    ],
)
def test_lights_below_the_horizon_are_chosen_where_they_can_contribute(bsdf, is_opaque):
    lights = {"above": point(0, 0.5, 1), "below": point(0, 0.5, -1)}
    counts = _counts(floor(bsdf(), **lights))
    assert counts["above"] > 100
    assert (counts["below"] == 0) == is_opaque
    if bsdf()["type"] == "twosided" and is_opaque:
        counts = _counts(floor(bsdf(), **lights), (0.5, 0, -1))
        assert counts["above"] == 0 and counts["below"] > 100, "seen from below"


def test_panels_that_shine_elsewhere_are_not_chosen():
    scene = floor(
        diffuse(),
        away=panel(0, 0, 1, radiance=1000.0),
        disk={
            "type": "disk", "to_world": translate(0.5, 0, 2), "emitter": area(1000.0)
        },
        down=panel(0, 1, 1, angle=180),
        # The vertex is behind its centre's horizon, but not behind its plane
        grazing=panel(1, 0, 0.001, angle=90, size=0.5),
    )  # fmt: skip
    counts = _counts(scene)
    assert counts["away"] == 0 and counts["disk"] == 0
    assert counts["down"] > 100 and counts["grazing"] > 100


def test_a_light_that_nothing_faces_is_never_chosen_in_a_render():
    lamp = {"lamp": panel(0, 0, 1, angle=180)}
    up = {"up": panel(0, 0.5, 2, radiance=1e4)}
    camera = {"sensor": sensor(film=film(8, 8))}
    variances = []
    for lights in (lamp, lamp | up):
        scene = floor(diffuse(), **camera, **lights)
        images = batches(scene, _integrator(2), 16, range(4))
        variances.append(np.var(images, axis=0).mean())
    # Choosing it would waste almost all samples
    assert variances[1] < 2 * variances[0]


def test_where_no_light_contributes_the_choice_is_uniform():
    lights = {f"p{i}": point(i, 0, -1, intensity=1 + 10.0 * i) for i in range(4)}
    lights["off"] = point(0, 1, -1, sampling_weight=0.0)
    counts = _counts(floor(diffuse(), **lights))
    assert counts.pop("off") == 0
    np.testing.assert_allclose(list(counts.values()), LANES / 4, rtol=0.05)


# ---- One, none ----


def test_one_emitter_needs_no_estimates_and_no_emitter_needs_no_tables():
    scene = floor(diffuse(), lamp=panel(0, 0, 1, angle=180))
    selection = LinearChoice(scene)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 4)
    assert selection.begin(sampler, mi.Ray3f()) is None
    image = batches(floor(diffuse(), sensor=sensor(), lamp=panel(0, 0, 1, angle=180)),
                    _integrator(3), 4, [1])  # fmt: skip
    assert image.mean() > 0
    dark = floor(diffuse(), sensor=sensor())
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
        "a": panel(0.2, 0, 0.9, angle=180),
        "b": {"type": "sphere", "radius": 0.1, "to_world": translate(-0.5, 0.4, -0.2),
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
