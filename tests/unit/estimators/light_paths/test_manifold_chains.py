"""Chains through casters: their derivatives, and the tables of casters."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_ext.estimators.light_paths.manifolds.casters import Casters, casters_of
from mitsuba_ext.estimators.light_paths.manifolds.chain import Chains
from mitsuba_ext.estimators.light_paths.manifolds.microfacets import random_offsets
from mitsuba_ext.estimators.light_paths.manifolds.solver import Target, missed
from mitsuba_ext.transport.queries.scene import scene_query
from tests.support.casters import (
    GLASS,
    ROUGH_GLASS,
    lamp_above,
    plane_at,
    scene_of,
    wavy_surface,
)

pytestmark = pytest.mark.usefixtures("variant")


def _casters() -> dict[str, Any]:
    metal = {"type": "twosided", "bsdf": {"type": "conductor"}}
    return {
        "sphere": {"type": "sphere", "radius": 0.8, "bsdf": GLASS},
        "metal_sphere": {"type": "sphere", "radius": 0.8, "bsdf": metal},
        "rough_sphere": {"type": "sphere", "radius": 0.8, "bsdf": ROUGH_GLASS},
        "plane": plane_at(0.0, GLASS),
        "cylinder": {
            "type": "cylinder", "p0": [-1, 0, 0], "p1": [1, 0, 0], "radius": 0.7, "bsdf": metal,
        },
        "mesh": wavy_surface(False),
        "mesh_with_coordinates": wavy_surface(True),
    }  # fmt: skip


@pytest.mark.parametrize("transmits", [0, 1, 3])
@pytest.mark.parametrize("kind", [
    "sphere", "metal_sphere", "rough_sphere", "plane", "cylinder", "mesh", "mesh_with_coordinates",
])  # fmt: skip
def test_derivatives_of_chains_are_those_of_finite_differences(kind: str, transmits: int) -> None:
    caster = _casters()[kind]
    glass = not kind.startswith(("metal", "cylinder"))
    length = 2 if transmits == 3 else 1
    if transmits and not glass or length == 2 and "sphere" not in kind:
        pytest.skip("no such chain")
    scene = scene_of(caster=caster, lamp=lamp_above())
    casters = Casters(casters_of(scene))
    chains = Chains(scene, scene_query(scene), casters, mi.BSDFContext())
    o, d = mi.Point3f(0.3, 0.2, 1.7), dr.normalize(mi.Vector3f(-0.22, -0.05, -1.0))
    frame, h = mi.Frame3f(d), 2e-3
    offsets = mi.Vector4f(0.8, -0.5, 0.3, 1.2) if casters.are_rough else None

    def end(s: float, t: float):
        turned = dr.normalize(d + s * frame.s + t * frame.t)
        ray = mi.Ray3f(o, turned)
        return chains.trace(ray, mi.UInt32(length), mi.UInt32(transmits), mi.Bool(False),
                            mi.Bool(True), offsets=offsets)  # fmt: skip

    state = end(0, 0)
    assert state.is_sound[0] and state.length[0] == length
    for name, plus, minus in (("s", end(h, 0), end(-h, 0)), ("t", end(0, h), end(0, -h))):
        for what in ("p", "d"):
            expected = (getattr(plus, what) - getattr(minus, what)) / (2 * h)
            found = np.array(getattr(state, f"{what}_{name}")).ravel()
            np.testing.assert_allclose(found, np.array(expected).ravel(), rtol=5e-3, atol=5e-3)


def test_the_offset_of_a_sampled_direction_leads_a_chain_there() -> None:
    """From outside and from inside. The weight of a chain is the albedo of its
    microfacet, up to shadowing and 1.5 for the densities."""
    scene = scene_of(ball={"type": "sphere", "radius": 0.8, "bsdf": ROUGH_GLASS}, lamp=lamp_above())
    casters = Casters(casters_of(scene))
    chains = Chains(scene, scene_query(scene), casters, mi.BSDFContext())
    offsets = random_offsets(dr.arange(mi.UInt32, 64))
    for o, transmits in ([1.9, 0], [1.9, 1], [0.1, 1]):
        ray = mi.Ray3f(mi.Point3f(0.3, 0.2, o), dr.normalize(mi.Vector3f(-0.22, -0.05, -1.0)))
        is_through = mi.Bool(transmits == 1)
        end = chains.trace(ray, mi.UInt32(1), mi.UInt32(transmits), mi.Bool(False), mi.Bool(True),
                           weighs=True, offsets=offsets)  # fmt: skip
        sound = np.array(end.is_sound)
        assert sound.mean() > 0.9
        si = scene.ray_intersect(ray)
        found = casters.offset(si, si.to_local(end.d), is_through)
        np.testing.assert_allclose(
            np.array(found)[:, sound], np.array(offsets)[:2, sound], rtol=1e-3, atol=1e-3
        )
        assert (np.array(end.chance)[sound] < 1.6).all()


def test_a_chain_ends_where_its_last_ray_ends() -> None:
    """Rays start at an offset from a surface. Chains that end elsewhere are not those that
    scattering finds."""
    scene = scene_of(caster=_casters()["sphere"], lamp=lamp_above())
    chains = Chains(scene, scene_query(scene), Casters(casters_of(scene)), mi.BSDFContext())
    ray = mi.Ray3f([0.3, 0.2, -1.7], dr.normalize(mi.Vector3f(-0.12, -0.05, 1.0)))
    end = chains.trace(ray, mi.UInt32(2), mi.UInt32(3), mi.Bool(False), mi.Bool(True))
    assert end.length[0] == 2
    miss = missed(end, Target(end.o + 0.9 * end.d, mi.Bool(False)))
    assert miss.is_sound[0] and miss.error[0] < 1e-6


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("kind", ["sphere", "disk", "rectangle", "cylinder", "ply"])
def test_tables_of_casters_hold_the_normals_of_mitsuba(kind: str, flip: bool, tmp_path) -> None:
    rotate = mi.ScalarTransform4f().rotate([1 / 3, 2 / 3, 2 / 3], 40)
    to_world = mi.ScalarTransform4f().translate([0.2, -0.1, 0.3]).scale(0.8) @ rotate
    shape = {"type": kind, "to_world": to_world, "flip_normals": flip, "bsdf": GLASS}
    if kind == "ply":
        wavy_surface(True).write_ply(str(tmp_path / "wavy.ply"))
        shape["filename"] = str(tmp_path / "wavy.ply")
    scene = scene_of(caster=shape)
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(1, 64)
    origin = mi.Point3f(*(6 * numbers.next_1d() - 3 for _ in range(2)), 4)
    aim = mi.Point3f(*(numbers.next_1d() - 0.5 for _ in range(3)))
    ray = mi.Ray3f(origin, dr.normalize(aim - origin))
    pi = scene.ray_intersect_preliminary(ray)
    si = pi.compute_surface_interaction(ray)
    hit = np.array(si.is_valid())
    assert hit.sum() > 5
    point, _change = Casters(casters_of(scene)).meet(pi, ray, si.is_valid())
    for found, expected in ((point.p, si.p), (point.shading_normal, si.sh_frame.n)):
        found, expected = (np.array(x)[:, hit] for x in (found, expected))
        np.testing.assert_allclose(found, expected, atol=1e-5)
    along = np.array(abs(dr.dot(point.normal, si.n)))[hit]
    np.testing.assert_allclose(along, 1, atol=1e-5)
    np.testing.assert_allclose(np.array(point.eta)[hit], 1.5 / 1.000277, rtol=1e-6)  # in air


def test_searches_may_begin_at_every_part_of_a_thin_caster() -> None:
    """Its table has no point near some of its parts: 1024 points on a strip 10 000 times as long
    as wide."""
    to_world = mi.ScalarTransform4f().scale([10, 0.001, 1])
    strip = {"type": "rectangle", "to_world": to_world, "bsdf": GLASS}
    casters = Casters(casters_of(scene_of(strip=strip)))
    numbers = mi.load_dict({"type": "independent"})
    numbers.seed(1, 1 << 18)
    v = mi.Vector3f(*(numbers.next_1d() for _ in range(3)))
    x = np.array(casters.near(numbers.next_1d(), v, numbers.next_1d()).x)
    counts, _edges = np.histogram(x, 400, (-10, 10))
    assert (counts > 0).all()
