"""``lightweight_mesh`` looks like the mesh that is nested in it."""

from __future__ import annotations

import gc
import weakref
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.support.stage import area, bitmap, diffuse, mesh, sensor, stage
from tests.support.statistical import assert_same_image, assert_same_mean, batches

Scene = dict[str, Any]

pytestmark = pytest.mark.usefixtures("variant")

AOVS = ("a:albedo,z:depth,p:position,uv:uv,g:geo_normal,n:sh_normal,u:dp_du,v:dp_dv,dx:duv_dx,"
        "dy:duv_dy")  # fmt: skip


def _torus(**children: Any) -> mi.Mesh:
    """A smooth ring with normals and texture coordinates."""
    count = 24
    u, v = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
    a, b = 2 * np.pi * u / count, 2 * np.pi * v / count
    normals = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], axis=-1)
    centres = np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1)
    points = 0.45 * centres + 0.2 * normals + [0, 0, 0.6]
    corner = (u * (count + 1) + v)[:-1, :-1]
    quad = [corner, corner + count + 1, corner + count + 2, corner + 1]
    triples = ([0, 1, 2], [0, 2, 3])
    faces = [np.stack([quad[k] for k in ks], axis=-1).reshape(-1, 3) for ks in triples]
    shape = mesh(points.reshape(-1, 3), np.concatenate(faces), normals.reshape(-1, 3), **children)
    return shape, np.stack([u, v], axis=-1).reshape(-1, 2) / count


def _ring(**children: Any) -> mi.Mesh:
    """The ring, written and read again, since only files have texture coordinates."""
    return _torus(**children)[0]


def _around(shape: Any, **parameters: Any) -> Scene:
    return {"type": "lightweight_mesh", **parameters, "nested": shape}


def _image(scene: Scene, integrator: str = "composed_path", spp: int = 16, **more: Any):
    loaded = mi.load_dict(scene, optimize=False)
    depth = {} if "nested" in more else {"max_depth": 5}
    integrator = mi.load_dict({"type": integrator, **depth, **more})
    # Mitsuba's duv_dx is NaN where no surface is seen
    return np.nan_to_num(integrator.render(loaded, seed=5, spp=spp).numpy())


def _ply(tmp_path, **changes: Any) -> Scene:
    """The ring with texture coordinates, as a file."""
    shape, uv = _torus()
    with_uv = mi.Mesh("ring", shape.vertex_count(), shape.face_count(), has_vertex_normals=True,
                      has_vertex_texcoords=True)  # fmt: skip
    old, new = mi.traverse(shape), mi.traverse(with_uv)
    for key in ("vertex_positions", "vertex_normals", "faces"):
        new[key] = old[key]
    new["vertex_texcoords"] = mi.Float(uv.ravel())
    new.update()
    with_uv.write_ply(str(tmp_path / "ring.ply"))
    pixels = np.random.default_rng(1).uniform(0.1, 0.9, (16, 16, 3))
    texture = {"type": "bitmap", "bitmap": bitmap(pixels), "raw": True}
    return {"type": "ply", "filename": str(tmp_path / "ring.ply"),
            "bsdf": {"type": "diffuse", "reflectance": texture}, **changes}  # fmt: skip


@pytest.mark.parametrize("changes", [{}, {"face_normals": True}, {"flip_normals": True}], ids=str)
@pytest.mark.parametrize("quantized", [False, True])
def test_image_and_output_variables_agree_with_the_mesh(
    tmp_path, changes: Scene, quantized: bool
) -> None:
    ring = _ply(tmp_path, **changes)
    expected = _image(stage(ring=ring), aovs=AOVS)
    found = _image(stage(ring=_around(ring, quantized=quantized)), aovs=AOVS)
    if not quantized:
        assert_same_image(found, expected, share=0.99)
        return
    # Rounded to 1/65536 of the ring, which moves a ray to another triangle here and there
    near = np.isclose(found, expected, rtol=0.02, atol=0.02)
    assert near.mean() > 0.97 and np.allclose(found.mean(), expected.mean(), rtol=0.01)


@pytest.mark.parametrize(
    "integrator", ["bdpt", "neepp", *(pytest.param(name, marks=pytest.mark.slow) for name in (
        "auto", "auto_path", "light_tracer", "vcm", "sppm", "mlt", "pssmlt", "erpt", "swarm_path",
        "adaptive", "ecoc_dof", "photon_map", "pss_guided", "two_stage",
        "instant_radiosity", "irradiance_cache"))]
)  # fmt: skip
def test_integrators_see_it(tmp_path, integrator: str) -> None:
    ring = _ply(tmp_path)
    camera, nested = None, {}
    if integrator == "ecoc_dof":
        camera = sensor("thinlens", aperture_radius=0.01, focus_distance=4.0)
    if integrator in ("ecoc_dof", "adaptive"):
        nested = {"nested": {"type": "composed_path", "max_depth": 5}}
    expected, found = (
        _image(stage(camera=camera, ring=shape), integrator, 256 if nested else 16, **nested)
        for shape in (ring, _around(ring))
    )
    # What is learned differs with the time that it takes, if with nothing else
    np.testing.assert_allclose(found.mean(), expected.mean(), rtol=0.05)
    blocks = [image.reshape(4, 4, 4, 4, 3).mean(axis=(1, 3)) for image in (found, expected)]
    assert np.abs(blocks[0] - blocks[1]).max() < 0.25 * blocks[1].mean()


@pytest.mark.parametrize(
    "integrator", ["composed_path", "bdpt", "composed_path linear", "composed_path spatial"]
)
def test_mesh_that_emits_light_gives_the_light_of_the_mesh(integrator: str) -> None:
    lamp = _ring(emitter=area(4.0), bsdf=diffuse(0.2))
    around = _around(_ring(emitter=area(4.0), bsdf=diffuse(0.2)))
    name, *choice = integrator.split()
    more = {"next_event": choice[0]} if choice else {}
    images = [
        batches(mi.load_dict(stage(light={}, lamp=shape), optimize=False),
                mi.load_dict({"type": name, "max_depth": 4, **more}), 64, seeds)
        for shape, seeds in ((lamp, range(16)), (around, range(16, 32)))
    ]  # fmt: skip
    assert_same_mean(*images)


def test_light_is_sampled_by_area_though_its_triangles_are_sorted() -> None:
    x = np.arange(9.0)[:, None, None] * [1.0, 0, 0]
    edges = np.arange(1, 10.0)[:, None, None] ** 2 * [[0, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]
    corners = (x[::-1] + edges).reshape(-1, 3)
    lamp = mesh(corners.tolist(), np.arange(27).reshape(-1, 3).tolist(), emitter=area(1.0))
    shape = mi.load_dict(_around(lamp)).lightweight.surface
    count = 40_000
    sample = np.random.default_rng(2).random((2, count)).astype(np.float32)
    p = np.array(shape.sample_position(0, mi.Point2f(sample)).p)
    found = np.bincount(np.rint(8 - p[0]).astype(int), minlength=9) / count
    areas = np.arange(1, 10.0) ** 4
    assert np.allclose(found, areas / areas.sum(), atol=0.01)


def test_attributes_keep_their_vertices_and_faces() -> None:
    def coloured(name: str, per: int) -> mi.Mesh:
        texture = {"type": "mesh_attribute", "name": name}
        ring = _ring(bsdf={"type": "diffuse", "reflectance": texture})
        count = ring.vertex_count() if per else ring.face_count()
        values = np.random.default_rng(4).uniform(0, 1, 3 * count)
        ring.add_attribute(name, 3, values.astype(np.float32).tolist())
        return ring

    for name, per in (("vertex_colour", 1), ("face_colour", 0)):
        expected = _image(stage(ring=coloured(name, per)))
        assert_same_image(_image(stage(ring=_around(coloured(name, per)))), expected, share=0.99)


def test_a_medium_inside_looks_as_inside_the_mesh() -> None:
    fog = {"type": "homogeneous", "sigma_t": 3.0, "albedo": 0.8}

    def filled() -> mi.Mesh:
        return _ring(interior=fog, bsdf={"type": "null"})

    expected = _image(stage(ring=filled()), spp=32)
    assert_same_image(_image(stage(ring=_around(filled())), spp=32), expected, share=0.97)


def test_other_shapes_may_move_beside_it(tmp_path) -> None:
    ring = _ply(tmp_path)
    camera = sensor(shutter_open=0.0, shutter_close=1.0)
    ball = {"type": "moving", "translate": [0.6, 0, 0.4], "ball": {"type": "sphere", "radius": 0.3}}
    expected, found = (
        _image(stage(camera=camera, ball=ball, ring=shape), aovs=AOVS)
        for shape in (ring, _around(ring))
    )
    assert_same_image(found, expected, share=0.98)


def test_gradients_of_its_colour_agree_with_the_mesh() -> None:
    gradients = []
    for wrap in (lambda shape: shape, _around):
        scene = mi.load_dict(stage(ring=wrap(_ring(bsdf=diffuse(0.3, 0.5, 0.7)))), optimize=False)
        parameters = mi.traverse(scene)
        key = next(k for k in parameters.keys() if k.startswith("ring.bsdf"))
        dr.enable_grad(parameters[key])
        parameters.update()
        integrator = mi.load_dict({"type": "composed_prb", "max_depth": 4})
        image = mi.render(scene, parameters, integrator=integrator, seed=2, spp=32)
        dr.backward(dr.mean(image))
        gradients.append(np.array(dr.grad(parameters[key])).ravel())
        dr.disable_grad(parameters[key])
    assert np.allclose(*gradients, rtol=0.01)


@pytest.mark.parametrize("variant", ["llvm_ad_spectral"], indirect=True)
@pytest.mark.slow
def test_spectral_image_agrees_with_the_mesh(variant: str) -> None:
    expected, found = (
        _image(stage(ring=wrap(_ring(bsdf=diffuse(0.3, 0.5, 0.7)))), aovs=AOVS)
        for wrap in (lambda shape: shape, _around)
    )
    assert_same_image(found, expected, share=0.98)


def test_scene_file_keeps_it_apart_from_other_meshes(tmp_path, make_scene) -> None:
    _ply(tmp_path)
    ply = f'<shape type="ply"><string name="filename" value="{tmp_path / "ring.ply"}"/></shape>'
    quantized = '<boolean name="quantized" value="true"/>'
    path = make_scene(body=f'<shape type="lightweight_mesh">{quantized}{ply}</shape>{ply}')
    scene = mi.load_file(str(path))
    (lightweight,) = (s for s in scene.shapes() if hasattr(s, "lightweight"))
    text = str(lightweight)
    assert "triangles = 1152" in text and "quantized = true" in text and "bytes per" in text


def test_it_does_not_outlive_its_scene() -> None:
    for quantized in (False, True):
        shape = mi.load_dict(_around(_ring(), quantized=quantized))
        geometry = weakref.ref(shape.lightweight)
        del shape
        gc.collect()
        assert geometry() is None


def test_integrators_that_do_not_see_it_are_refused() -> None:
    scene = mi.load_dict(stage(ring=_around(_ring())))
    nested = {"type": "variance", "nested": {"type": "path"}}
    with pytest.raises(NotImplementedError, match='does not see the shape "lightweight_mesh"'):
        mi.load_dict(nested).render(scene, spp=4)


@pytest.mark.parametrize(
    ("nested", "message"),
    [
        ({}, "one mesh must be nested in it, found 0"),
        ({"a": {"type": "cube"}, "b": {"type": "cube"}}, "one mesh must be nested in it, found 2"),
        ({"a": {"type": "sphere"}}, "only a mesh of triangles"),
        ({"a": {"type": "rectangle"}}, "only a mesh of triangles"),
        ({"a": {"type": "diffuse"}}, "belong into the nested mesh"),
        ({"a": _around({"type": "cube"})}, "only a mesh of triangles"),
        ({"a": {"type": "cube", "emitter": area(1.0)}, "quantized": True}, "cannot be quantized"),
        ({"a": {"type": "cube"}, "quantized": 1}, '"quantized" is 1; it must be of type bool'),
    ],
)  # fmt: skip
def test_meshes_that_it_cannot_hold_are_refused(nested: Scene, message: str) -> None:
    with pytest.raises(Exception, match=message):
        mi.load_dict({"type": "lightweight_mesh", **nested})


@pytest.mark.parametrize("quantized", [False, True])
def test_points_that_are_not_finite_are_refused(quantized: bool) -> None:
    broken = mesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]])
    with pytest.raises(Exception, match="vertex 2 is not finite"):
        mi.load_dict(_around(broken, quantized=quantized))


def test_it_cannot_move() -> None:
    with pytest.raises(Exception, match="cannot move; nest the mesh itself"):
        mi.load_dict({"type": "moving", "translate": [1, 0, 0], "a": _around({"type": "cube"})})
