"""Lights of every shape, samples of their cells, and rays that find them, for tests of the
cells."""

from __future__ import annotations

import functools
import os
import tempfile
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_ext.scene.lights.division import emitter_shapes
from mitsuba_ext.scene.lights.light_cells import LightCells

#: All lights lie around here and are about two wide; they are seen from the origin.
CENTER = np.array([0.3, -0.4, 3.0])
VOXEL = 0.4
LANES = 1 << 17

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


def scene_with(
    shapes: dict[str, dict], scale: float = 1, offset: float = 0, emitter=None
) -> mi.Scene:
    """Lights, placed one step apart from each other."""
    lights = {}
    for index, (name, shape) in enumerate(shapes.items()):
        center = scale * (CENTER + index * _STEP) + offset
        place = _T().translate(center.tolist()).scale(scale)
        to_world = place @ shape.get("to_world", _T())
        lights[name] = {**shape, "to_world": to_world, "emitter": emitter or {"type": "area"}}
    return mi.load_dict({"type": "scene", **lights})


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
        share: The share of the light's cells. (The cells would keep the scene in all later
            kernels.)
        probability: The probability of each cell; some are zero if there are several.
        cell, pdf, value, d: What was chosen, the density without that choice's probability, the
            unoccluded radiance / pdf, the direction.
        visible: True if the point emits towards the origin, with nothing in between.
        cosine: Between that direction and the light.
        found_cell, found_pdf: The cell and the density that a ray towards the point finds.
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


#: Lights that share a scene, and with it the kernels: by what kind of cells they have.
_GROUPS = (
    ("rectangle", "slanted", "flipped"),
    ("disk", "ellipse", "cylinder", "tube"),
    ("sphere",),
    ("cube", "two triangles", "flipped mesh", "degenerate", "many faces"),
    ("smooth", "smooth patch"),
)

#: Lights that are also tested in small, large and distant scenes.
SCALED = ("slanted", "disk", "cylinder", "two triangles", "smooth")

#: From one light of a group to the next one.
_STEP = np.array([-12.0, 0.0, 0.0])


def samples_of(name: str, scale: float = 1, offset: float = 0) -> Samples:
    """What is sampled of a light, and what rays find, in a scene of its group."""
    groups = _GROUPS if (scale, offset) == (1, 0) else (SCALED,)
    group = next(group for group in groups if name in group)
    return _samples_of(group, scale, offset)[group.index(name)]


@functools.lru_cache(maxsize=100)
def _samples_of(group: tuple[str, ...], scale: float, offset: float) -> list[Samples]:
    scene = scene_with({name: SHAPES[name]() for name in group}, scale, offset)
    cells = LightCells(scene, mi.Vector3f(scale * VOXEL))
    rng, numbers = np.random.default_rng(7), mi.PCG32(size=len(group) * LANES)

    def square():
        return mi.Point2f(numbers.next_float32(), numbers.next_float32())

    owner = [group.index(shape.id()) for shape in emitter_shapes(scene)]
    owner = np.array(owner)[cells.emitter_index]
    members = [np.flatnonzero(owner == index) for index in range(len(group))]
    probability = []
    for member in members:
        p = rng.random(len(member))
        if len(p) > 2:
            p[rng.random(len(p)) < 0.3] = 0
        probability.append(p / p.sum())
    cell = np.concatenate([rng.choice(m, LANES, p=p) for m, p in zip(members, probability)])
    ref = dr.zeros(mi.Interaction3f, len(cell))
    places = np.repeat(scale * np.arange(len(group)), LANES) * _STEP[:, None] + offset
    ref.p = mi.Point3f(places.astype(np.float32))
    ds, weight = cells.sample(mi.UInt32(cell.astype(np.uint32)), ref, square(), mi.Bool(True))

    # Rays towards what was sampled; then rays in a cone that holds the light
    axis = dr.normalize(mi.Vector3f(CENTER.tolist()))
    edges = dr.dot(ds.d, axis).numpy().reshape(-1, LANES).min(axis=1)
    edges = np.where(edges > 0, edges - 0.02, -1.0)
    cone = mi.warp.square_to_uniform_cone(square(), mi.Float(np.repeat(edges, LANES)))
    found = []
    for d in (ds.d, mi.Frame3f(axis).to_world(cone)):
        si = scene.ray_intersect(mi.Ray3f(ref.p, d))
        hit = mi.DirectionSample3f(scene, si, ref)
        value = hit.emitter.eval(si)
        found_cell, found_pdf = cells.pdf(ref, si, hit, si.is_valid())
        visible = si.is_valid() & (dr.abs(si.t - ds.dist) < (1e-3 if offset else 3e-5) * ds.dist)
        visible &= mi.luminance(weight) > 0
        cosine = dr.abs(dr.dot(ds.d, si.n))
        found.append((found_cell, found_pdf, mi.luminance(value), visible, cosine, d))
        dr.eval(found)
    sampled = (mi.UInt32(cell.astype(np.uint32)), ds.pdf, mi.luminance(weight))
    return [
        _Part(index, member, owner).samples(cells.share, p, sampled, found, edge)
        for index, (member, p, edge) in enumerate(zip(members, probability, edges))
    ]


@dataclass
class _Part:
    """One light of a group: its lanes, and its cells, numbered as if it were alone."""

    index: int
    member: np.ndarray
    owner: np.ndarray

    def samples(self, share, probability, sampled, found, edge) -> Samples:
        lanes = slice(self.index * LANES, (self.index + 1) * LANES)
        cell, pdf, value = (x.numpy()[lanes] for x in sampled)
        to, rays = ([x.numpy()[..., lanes] for x in part] for part in found)
        # Rays that miss the light may meet another one
        misses = self.owner[rays[0]] != self.index
        for values in rays[1:3]:
            values[misses] = 0
        return Samples(
            share[self.member], probability, self._number(cell), pdf, value, to[5].T,
            to[3], to[4], self._number(to[0]), to[1],
            self._number(rays[0]), rays[1], rays[2], rays[5].T, 2 * np.pi * (1 - edge),
        )  # fmt: skip

    def _number(self, cell: np.ndarray) -> np.ndarray:
        number = np.zeros(len(self.owner), int)
        number[self.member] = np.arange(len(self.member))
        return number[cell]


def agree(a: np.ndarray, b: np.ndarray, errors: float = 4) -> bool:
    error = np.hypot(a.std() / np.sqrt(len(a)), b.std() / np.sqrt(len(b)))
    return abs(a.mean() - b.mean()) < errors * error
