"""Lights of every shape, and what their cells sample and rays find: for tests of the cells."""

from __future__ import annotations

import functools
import os
import tempfile
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.lights.light_cells import LightCells

#: All lights lie around here and are about two wide; they are seen from the origin.
CENTER = np.array([0.3, -0.4, 3.0])
VOXEL = 0.4
LANES = 1 << 18

_FOLDER = tempfile.TemporaryDirectory()  # removed when the process ends


# ---- Lights ----


def _ply(vertices, faces, normals=None) -> str:
    """Writes a mesh, which holds vertex normals where they are given."""
    mesh = mi.Mesh("light", len(vertices), len(faces), has_vertex_normals=normals is not None)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ravel(vertices).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    if normals is not None:
        parameters["vertex_normals"] = mi.Float(np.ravel(normals).astype(np.float32))
    parameters.update()
    path = f"{_FOLDER.name}/{len(os.listdir(_FOLDER.name))}.ply"
    mesh.write_ply(path)
    return path


def ball(columns: int, rows: int, smooth: bool = False) -> dict:
    """A dented sphere; its triangles at the poles have no area."""
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    phi, theta = 2 * np.pi * u.ravel(), np.pi * v.ravel()
    d = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    a, b, c, e = corner, corner + 1, corner + columns + 1, corner + columns + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, e], 1)])
    radius = 1 if smooth else 1 - 0.3 * np.abs(np.sin(2 * phi) * np.sin(theta))[:, None]
    return mesh(radius * d, faces, d if smooth else None)


def mesh(vertices, faces, normals=None, **more) -> dict:
    flat = normals is None
    return {"type": "ply", "filename": _ply(vertices, faces, normals), "face_normals": flat, **more}


SQUARE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0.5], [-1, 1, 0]]

#: Shape, and how it is turned before it is placed.
SHAPES = {
    "rectangle": lambda: {"type": "rectangle", "to_world": _turn(180)},
    "slanted": lambda: {"type": "rectangle", "to_world": _turn(230)},
    "flipped": lambda: {"type": "rectangle", "flip_normals": True},
    "disk": lambda: {"type": "disk", "to_world": _turn(210)},
    "ellipse": lambda: {"type": "disk", "to_world": _turn(200) @ _T().scale([0.3, 1.4, 1])},
    "cylinder": lambda: {"type": "cylinder", "to_world": _turn(70) @ _T().scale([0.4, 0.4, 1.5])},
    "tube": lambda: {
        "type": "cylinder", "flip_normals": True,
        "to_world": _T().translate([0, 0, -4]).scale([2, 2, 3]),
    },
    "sphere": lambda: {"type": "sphere"},
    "cube": lambda: {"type": "cube", "to_world": _turn(25).scale(0.6)},
    "two triangles": lambda: mesh(SQUARE, [[0, 1, 2], [0, 2, 3]], to_world=_turn(160)),
    "flipped mesh": lambda: mesh(SQUARE, [[0, 1, 2], [0, 2, 3]], flip_normals=True),
    "degenerate": lambda: mesh(
        SQUARE, [[0, 1, 1], [0, 1, 2], [2, 2, 2], [0, 2, 3], [3, 0, 3]], to_world=_turn(160)
    ),
    "many faces": lambda: ball(40, 20),
    "smooth": lambda: ball(7, 4, smooth=True),
    "smooth patch": lambda: mesh(
        SQUARE, [[0, 2, 1], [0, 3, 2]],
        [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]] / np.sqrt(3),
    ),
}  # fmt: skip

#: Which of them are not divided.
WHOLE = {"sphere"}


def _T():
    return mi.ScalarTransform4f()


def _turn(degrees: float):
    """Turned by this around x; 180° face the origin."""
    return _T().rotate([1, 0, 0], degrees)


def scene_with(shape: dict, scale: float = 1, offset: float = 0, emitter=None) -> mi.Scene:
    place = _T().translate((scale * CENTER + offset).tolist()).scale(scale)
    shape = {**shape, "to_world": place @ shape.get("to_world", _T())}
    return mi.load_dict(
        {"type": "scene", "shape": {**shape, "emitter": emitter or {"type": "area"}}}
    )


# ---- Lights that stay whole, and a scene of all lights ----

TEXTURE = np.linspace(0, 1, 48).reshape(4, 4, 3).astype(np.float32)

#: Where it is bright, it is so in a small part of any cell.
SPOTS = np.tile(np.pad(TEXTURE[:1, :1] + 1, ((0, 15), (0, 15), (0, 0))), (8, 8, 1))

WHOLE_LIGHTS = {
    "textured": lambda: _emitting(
        {"type": "area", "radiance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(SPOTS)}}
    ),
    "directionalarea": lambda: _emitting({"type": "directionalarea", "radiance": 3.0}),
    "point": lambda: {"type": "point", "position": [0, 0, 3]},
    "spot": lambda: {"type": "spot", "to_world": _facing_origin()},
    "projector": lambda: {
        "type": "projector", "to_world": _facing_origin(),
        "irradiance": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(TEXTURE)},
    },
    "directional": lambda: {"type": "directional", "direction": [0, 0, 1]},
    "directional environment": lambda: {"type": "constant"},
}  # fmt: skip


def _emitting(emitter: dict) -> dict:
    return {"type": "rectangle", "to_world": _T().translate([0, 0, 3]) @ _turn(180), "e": emitter}


def _facing_origin():
    return _T().look_at([0.1, 0.2, 3], [0, 0, 0], [0, 1, 0])


def mixed_scene(*more: str) -> mi.Scene:
    """One light of each kind around the origin, and a small ball that casts shadows."""
    lights = {"type": "scene", "ball": {"type": "sphere", "radius": 0.4, "center": [1, 0, 0.5]}}
    names = ["sphere", "slanted", "many faces", "disk", "smooth", "two triangles", "cylinder"]
    for k, name in enumerate(names):
        place = _T().rotate([0, 1, 0], 360 / len(names) * k).translate([0, 0, 4])
        shape = SHAPES[name]()
        shape["to_world"] = place @ shape.get("to_world", _T())
        radiance = {"type": "rgb", "value": 1.0 + k}
        lights[f"light_{k}"] = {**shape, "emitter": {"type": "area", "radiance": radiance}}
    return mi.load_dict({**lights, **{name: WHOLE_LIGHTS[name]() for name in more}})


# ---- What is sampled and what rays find ----


@dataclass
class Samples:
    """Choices by random probabilities, and rays in all directions towards the light.

    Attributes:
        share: Of the cells. (The cells themselves would keep the scene in all later kernels.)
        probability: Of each cell; some are zero if there are several.
        cell, pdf, value, d: What was chosen, the density without that choice's probability, the
            unoccluded radiance / pdf, the direction.
        visible: Does the point emit towards the origin, with nothing in between?
        cosine: Between that direction and the light.
        found_cell, found_pdf: What a ray towards the point finds.
        ray_cell, ray_pdf, ray_value, ray_d: What rays in other directions find; those that do not
            meet the light have the density 0.
        ray_angle: The solid angle from which these are drawn.
    """

    share: np.ndarray
    probability: np.ndarray
    cell: np.ndarray
    pdf: np.ndarray
    value: np.ndarray
    d: np.ndarray
    visible: np.ndarray
    cosine: np.ndarray
    found_cell: np.ndarray
    found_pdf: np.ndarray
    ray_cell: np.ndarray
    ray_pdf: np.ndarray
    ray_value: np.ndarray
    ray_d: np.ndarray
    ray_angle: float

    def fluence(self) -> tuple[np.ndarray, np.ndarray]:
        """Two estimates of what arrives from cells that can be chosen: of samples, and of rays."""
        chosen = self.value * self.visible / self.probability[self.cell]
        met = self.ray_value * (self.probability[self.ray_cell] > 0) * self.ray_angle
        return chosen, met


@functools.lru_cache(maxsize=100)
def samples_of(name: str, scale: float = 1, offset: float = 0) -> Samples:
    scene = scene_with(SHAPES[name](), scale, offset)
    cells = LightCells(scene, mi.Vector3f(scale * VOXEL))
    rng, numbers = np.random.default_rng(7), mi.PCG32(size=LANES)

    def square():
        return mi.Point2f(numbers.next_float32(), numbers.next_float32())

    probability = rng.random(cells.count)
    if cells.count > 2:
        probability[rng.random(cells.count) < 0.3] = 0
    probability *= 1 / probability.sum()
    cell = rng.choice(cells.count, LANES, p=probability)
    ref = dr.zeros(mi.Interaction3f, LANES)
    ref.p += offset
    ds, weight = cells.sample(mi.UInt32(cell.astype(np.uint32)), ref, square(), mi.Bool(True))

    # Rays towards what was sampled; then rays in a cone that holds the light
    axis = dr.normalize(mi.Vector3f(CENTER.tolist()))
    edge = float(dr.min(dr.dot(ds.d, axis))[0])
    edge = edge - 0.02 if edge > 0 else -1.0
    cone = mi.warp.square_to_uniform_cone(square(), edge)
    found = []
    for d in (ds.d, mi.Frame3f(axis).to_world(cone)):
        si = scene.ray_intersect(mi.Ray3f(ref.p, d))
        hit = mi.DirectionSample3f(scene, si, ref)
        value = hit.emitter.eval(si)
        found_cell, found_pdf = cells.pdf(ref, si, hit, si.is_valid())
        found.append((found_cell.numpy(), found_pdf.numpy(), mi.luminance(value).numpy()))
        visible = si.is_valid() & (dr.abs(si.t - ds.dist) < (1e-3 if offset else 3e-5) * ds.dist)
        visible &= mi.luminance(weight) > 0
        found[-1] += (visible.numpy(), dr.abs(dr.dot(ds.d, si.n)).numpy(), d.numpy().T)
    to_cell, to_pdf, _, visible, cosine, d = found[0]
    ray_cell, ray_pdf, ray_value, _, _, ray_d = found[1]
    return Samples(
        cells.share, probability, cell, ds.pdf.numpy(), mi.luminance(weight).numpy(), d,
        visible, cosine, to_cell, to_pdf,
        ray_cell, ray_pdf, ray_value, ray_d, 2 * np.pi * (1 - edge),
    )  # fmt: skip


def agree(a: np.ndarray, b: np.ndarray, errors: float = 4) -> bool:
    error = np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b)))
    return abs(a.mean() - b.mean()) < errors * error
