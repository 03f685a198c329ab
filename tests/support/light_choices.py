"""What tests of choices of lights share: scenes, points, and how often each light is chosen."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from mitsuba_ext.transport.path_decisions import EmitterSampling
from tests.support.maps import connect
from tests.support.stage import area, diffuse, lookat, rectangle, rgb, sensor

LANES = 1 << 16


def translate(*offset: float) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().translate(list(offset))


def point(*position: float, intensity: float = 1.0, **changes) -> dict:
    return {
        "type": "point", "position": list(position), "intensity": rgb(intensity), **changes
    }


def panel(*position: float, angle: float = 0.0, size: float = 0.3, radiance: float = 5.0) -> dict:
    """A rectangle that shines upwards, turned about the x axis."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], angle).scale(size)
    return rectangle(translate(*position), turn, bsdf=diffuse(0.0), emitter=area(radiance))


def mixed_lights() -> dict:
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
            "type": "sphere", "radius": 0.4, "to_world": translate(0.5, 0, 0.5),
            "bsdf": {"type": "roughplastic", "diffuse_reflectance": rgb(0.5, 0.3, 0.2)},
        },
        "leaf": rectangle(
            translate(-0.6, 0, 0.5), T().rotate([1, 0, 0], 70).scale(0.4),
            bsdf={"type": "principledthin", "base_color": rgb(0.3, 0.6, 0.2), "diff_trans": 1.2,
                  "roughness": 0.6, "spec_trans": 0.0},
        ),
        "wall": rectangle(
            translate(0, 1.5, 1), T().rotate([1, 0, 0], 90).scale([2, 1.5, 1]),
            bsdf={"type": "twosided", "bsdf": diffuse()},
        ),
        "below": panel(0, 0, -0.7),
        "globe": {
            "type": "sphere", "radius": 0.25, "to_world": translate(-0.9, -0.5, 0.1),
            "emitter": area(2.0),
        },
        "lamp": panel(0.3, -0.3, 2, angle=180),
        "point": point(0.2, 0.3, -0.4, intensity=0.5),
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


def vertex_at(scene: mi.Scene, origin: list[float], target: list[float]) -> mi.SurfaceInteraction3f:
    """The same surface point in all lanes."""
    o, t = mi.Point3f(*origin), mi.Point3f(*target)
    # Data, not literals of kernels
    dr.make_opaque(o, t)
    o += dr.zeros(mi.Point3f, LANES)
    return scene.ray_intersect(mi.Ray3f(o, dr.normalize(t - o)))


def select(selection: EmitterSampling, scene: mi.Scene, si: mi.SurfaceInteraction3f):
    """One choice for each lane: the sample, its weight, and the state behind the vertex."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(7, LANES)
    ds, weight, _choice, state = connect(selection, scene, sampler, si)
    return ds, weight, state


def choices_of(
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


def floor(bsdf: dict, **lights) -> mi.Scene:
    return mi.load_dict({"type": "scene", "floor": rectangle(bsdf=bsdf), **lights})


def assert_density_fits(selection: EmitterSampling, scene: mi.Scene) -> None:
    """Tests, at points of :func:`mixed_lights`, that emitters are chosen as often as the density
    says, and that a ray which runs into what was chosen finds the same density."""
    vertices = {
        "glass, from above": ([0.1, -2, 2], [0.1, -0.6, 0]),
        "from below": ([0.1, -0.2, -0.2], [0.2, -0.6, 0]),
        "wall": ([0, -2, 1], [0, 1.5, 1]),
        "ball": ([0.5, -2, 0.6], [0.5, 0, 0.5]),
    }
    for vertex in vertices.values():
        si = vertex_at(scene, *vertex)
        ds, _weight, state = select(selection, scene, si)
        choices = choices_of(scene, si, ds)
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
        assert same.mean() > 0.01
        np.testing.assert_allclose(pdf.numpy()[same], ds.pdf.numpy()[same], rtol=2e-3)
        assert not pdf.numpy()[~same].any(), "masked lanes"


def counts_at(
    selection: EmitterSampling, scene: mi.Scene, origin: tuple = (0.5, 0, 1)
) -> dict[str, int]:
    """How often each emitter is chosen at the origin, seen from ``origin``."""
    si = vertex_at(scene, list(origin), [0, 0, 0])
    ds, _weight, _state = select(selection, scene, si)
    return {name: count for name, (count, _α) in choices_of(scene, si, ds).items()}
