"""Cells (parts of emitters): sampling a point on a cell, and finding the cell of a point."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np

from ...util.arrays import from_numpy
from ...util.discrete_sampling import ONE_MINUS_EPSILON, first_above
from .division import Division, divide, emitter_shapes, triangles


class EmitterCells:
    """The cells of emitters, numbered from 0 to ``count`` − 1.

    Parameters:
        scene: The scene that holds the emitters.
        indices: The scene indices of the emitters to divide; at least one.
        voxel: The three edges of a box. Longer emitters are divided; with ``None``, each emitter is
            one cell.
        face_cells: Divides meshes into their faces (:func:`~.division.divide`).

    Attributes:
        count (int): Number of cells.
        emitter_index (numpy.ndarray): The scene index of each cell's emitter; shape [count].
        share (numpy.ndarray): The fraction of its emitter's area, and hence of its emitter's
            samples, in each cell; shape [count].
        has_smooth_meshes (bool): Whether an emitter is a mesh with interpolated normals. Mitsuba's
            own sampling of such a mesh has a wrong density.
    """

    def __init__(
        self,
        scene: mi.Scene,
        indices: list[int],
        voxel: mi.Vector3f | None,
        face_cells: int = 0,
    ) -> None:
        # Kept alive: once an emitter's shape is freed, the next call to any scene's emitters
        # crashes
        self._scene = scene
        edges = None if voxel is None else np.array(voxel, dtype=np.float64).reshape(3)
        everything = divide(scene, edges, face_cells)
        shapes = emitter_shapes(scene)
        divisions = [everything[i] for i in indices]
        sizes = np.concatenate([d.cell_sizes for d in divisions])
        pieces = np.concatenate([d.pieces for d in divisions])
        cell_counts = np.array([len(d.cell_sizes) for d in divisions])
        self.count = len(sizes)
        number = np.repeat(np.arange(len(indices)), cell_counts)
        self.emitter_index = np.array(indices)[number]
        self._divisions = dict(zip(indices, divisions))
        measure = pieces[:, 2] * pieces[:, 3]
        ends = np.cumsum(sizes)
        self.share = np.add.reduceat(measure, ends - sizes)

        self._only = scene.emitters()[indices[0]] if len(indices) == 1 else None
        self._emitters = dr.gather(
            mi.EmitterPtr, scene.emitters_dr(), from_numpy(mi.UInt32, indices)
        )
        self._emitter = from_numpy(mi.UInt32, number)
        self._is_divided = any(d.shape for d in divisions)
        # A textured emitter would sample its texture, so its cells are sampled on its shape
        self._by_area = [
            functools.partial(_sample_by_area, shapes[i], scene.emitters()[i])
            for i, d in zip(indices, divisions) if d.is_textured
        ]
        if self._by_area:
            is_textured = np.array([d.is_textured for d in divisions])
            self._is_textured = mi.Bool(is_textured)
            self._textured_number = from_numpy(mi.UInt32, (np.cumsum(is_textured) - 1).clip(0))
        self._longest = int(sizes.max())
        self._has_groups = self._longest > 1
        # Keeps rounding from moving a sample into the neighbouring piece
        inset = np.minimum(2.0**-23, 0.25 * pieces[:, 2:]).T
        corner, size = pieces[:, :2].T + inset, pieces[:, 2:].T - 2 * inset
        # Corner and size of a piece side by side: one access to memory reads all four
        self._pieces = from_numpy(mi.Float, np.concatenate([corner, size]).T)
        self._share = from_numpy(mi.Float, self.share)
        if self._has_groups:
            self._last_piece = from_numpy(mi.UInt32, ends - 1)
            self._first_piece = from_numpy(mi.UInt32, ends - sizes)
            # Within each cell, the running sum of the shares of its pieces
            total = np.cumsum(measure)
            below = np.concatenate([[0.0], total])[ends - sizes]
            cumulative = (total - np.repeat(below, sizes)) / np.repeat(
                np.maximum(self.share, 1e-300), sizes
            )
            cumulative[ends - 1] = 1
            self._cumulative = from_numpy(mi.Float, cumulative)
        self._inverse([shapes[i] for i in indices], divisions, cell_counts, sizes)

    def faces(self, index: int, count: int) -> np.ndarray:
        """The cell of each of the ``count`` faces of a mesh that is not cut, by the scene index of
        its emitter."""
        first, division = np.argmax(self.emitter_index == index), self._divisions[index]
        if division.shape != "mesh":
            return np.full(count, first)
        return first + division.cell_of_piece

    def _inverse(
        self,
        shapes: list[mi.Shape | None],
        divisions: list[Division],
        cell_counts: np.ndarray,
        sizes: np.ndarray,
    ) -> None:
        """Makes the tables that map an emitter's index in Dr.Jit's registry to its cells."""
        ids = dr.reinterpret_array(mi.UInt32, self._emitters).numpy()
        kinds = {d.shape for d in divisions}
        self._kinds = kinds
        self.has_smooth_meshes = any(d.is_smooth for d in divisions)

        def by_id(values, kind=mi.UInt32) -> mi.UInt32 | mi.Float:
            table = np.zeros(int(ids.max(initial=0)) + 1)
            table[ids] = values
            return from_numpy(kind, table)

        if self._by_area:
            self._is_textured_id = by_id([d.is_textured for d in divisions])
            areas = [_area(s) if d.is_textured else 1.0 for s, d in zip(shapes, divisions)]
            self._density = by_id(1 / np.array(areas), mi.Float)
        first = np.cumsum(cell_counts) - cell_counts
        self._first_cell = by_id(first)
        if kinds - {"", "mesh"}:
            self._columns = by_id([d.grid[0] for d in divisions])
            self._rows = by_id([d.grid[1] for d in divisions])
        if "disk" in kinds or "cylinder" in kinds:
            self._shape = by_id([("", "rectangle", "disk", "cylinder", "mesh").index(d.shape)
                                 for d in divisions])
        if "mesh" not in kinds:
            return
        # Faces are numbered over all meshes. Entries of emitters that are not meshes are not used
        face_counts = [len(d.face_first) - 1 if d.shape == "mesh" else 0 for d in divisions]
        self._first_face = by_id(np.cumsum(face_counts) - face_counts)
        self._is_mesh = by_id([d.shape == "mesh" for d in divisions])
        meshes = [(d, f) for d, f in zip(divisions, first) if d.shape == "mesh"]
        cuts, first_entry, cell_of, entries = [], [], [], 0
        for d, f in meshes:
            cuts.append(np.sqrt(np.diff(d.face_first)).round().astype(np.uint32))
            first_entry.append(d.face_first[:-1] + entries)
            cell_of.append(d.cell_of_piece + f)
            entries += d.face_first[-1]
        self._face_cuts = from_numpy(mi.UInt32, np.concatenate(cuts))
        self._face_first = from_numpy(mi.UInt32, np.concatenate(first_entry))
        self._cell_of_piece = from_numpy(mi.UInt32, np.concatenate(cell_of))
        self._has_cut_faces = any(int(c.max(initial=1)) > 1 for c in cuts)
        if self._has_cut_faces:
            corners = [triangles(mesh) for mesh, d in zip(shapes, divisions) if d.shape == "mesh"]
            a, b, c = (np.concatenate(x).T for x in zip(*corners))
            self._a, self._ab, self._ac = (
                mi.Vector3f(*(from_numpy(mi.Float, axis) for axis in x)) for x in (a, b - a, c - a)
            )
        if self.has_smooth_meshes:
            normals = np.zeros((int(sizes.sum()), 3), dtype=np.float32)
            smooth = np.zeros(len(normals), dtype=bool)
            end = 0
            for d in divisions:
                begin, end = end, end + len(d.pieces)
                if d.is_smooth:
                    normals[begin:end], smooth[begin:end] = d.normals, True
            self._normal = mi.Normal3f(*(from_numpy(mi.Float, axis) for axis in normals.T))
            self._is_smooth_piece = from_numpy(mi.Bool, smooth)
            self._is_smooth = by_id([d.is_smooth for d in divisions])

    def sample(
        self, cell: mi.UInt32, ref: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Samples a point on ``cell``.

        Returns:
            The direction sample, whose ``pdf`` is conditional on the cell, and its radiance / pdf,
            before any visibility test.
        """
        if self._is_divided:
            piece, x = cell, sample.x
            if self._has_groups:
                piece, x = self._piece(cell, x, active)
            left, bottom, width, height = dr.gather(mi.Vector4f, self._pieces, piece, active)
            sample = mi.Point2f(dr.fma(x, width, left), dr.fma(sample.y, height, bottom))
        ds, weight = self._sample_emitter(cell, ref, sample, active)
        # Some emitters return values in masked lanes
        pdf = dr.select(active, ds.pdf, 0)
        weight = dr.select(active, weight, 0)
        if self._is_divided:
            share = dr.gather(mi.Float, self._share, cell, active)
            pdf = dr.select(share > 0, pdf / share, 0)
            weight *= share
        if self.has_smooth_meshes:
            n = dr.gather(mi.Normal3f, self._normal, piece, active)
            smooth = dr.gather(mi.Bool, self._is_smooth_piece, piece, active)
            ratio = dr.select(smooth, _cosine_ratio(ds, n), 1)
            pdf *= ratio
            weight *= dr.select(ratio > 0, dr.rcp(ratio), 0)
        ds.pdf = pdf
        return ds, weight

    def _sample_emitter(self, cell, ref, sample, active):
        """The direction sample that the cell's emitter assigns to a point of the unit square."""
        emitter = self._pointer(cell, active)
        if not self._by_area:
            return emitter.sample_direction(ref, sample, active)
        number = dr.gather(mi.UInt32, self._emitter, cell, active)
        textured = dr.gather(mi.Bool, self._is_textured, number, active)
        ds, weight = emitter.sample_direction(ref, sample, active & ~textured)
        textured &= active
        # Not by a call through a pointer: Dr.Jit would trace all shapes and emitters in memory,
        # including other scenes, and some raise errors (a curve cannot be sampled by area)
        number = dr.gather(mi.UInt32, self._textured_number, number, textured)
        by_area, value = dr.switch(number, self._by_area, ref, sample, textured)
        by_area.emitter = mi.EmitterPtr(emitter)
        return dr.select(textured, by_area, ds), dr.select(textured, value, weight)

    def _piece(self, cell, x, active) -> tuple[mi.UInt32, mi.Float]:
        """Chooses a piece of ``cell`` with the random number ``x``.

        Returns:
            The piece, and the number rescaled to [0, 1).
        """
        first = dr.gather(mi.UInt32, self._first_piece, cell, active)
        last = dr.gather(mi.UInt32, self._last_piece, cell, active)
        piece = first_above(self._cumulative, first, last, x, active, self._longest)
        high = dr.gather(mi.Float, self._cumulative, piece, active)
        low = dr.gather(mi.Float, self._cumulative, piece - 1, active & (piece > first))
        return piece, dr.clip((x - low) / (high - low), 0, ONE_MINUS_EPSILON)

    def _pointer(self, cell: mi.UInt32, active: mi.Bool):
        if self._only is not None:
            return self._only
        index = cell
        if self._is_divided:
            index = dr.gather(mi.UInt32, self._emitter, cell, active)
        return dr.gather(mi.EmitterPtr, self._emitters, index, active)

    def pdf(
        self,
        ref: mi.Interaction3f,
        si: mi.SurfaceInteraction3f,
        ds: mi.DirectionSample3f,
        active: mi.Bool,
    ) -> tuple[mi.UInt32, mi.Float]:
        """The cell that a ray from ``ref`` hit at ``si``, and the density of the ray's direction
        under :meth:`sample`, conditional on the cell."""
        id = dr.reinterpret_array(mi.UInt32, ds.emitter)
        textured = mi.Bool(False)
        if self._by_area:
            textured = active & (dr.gather(mi.UInt32, self._is_textured_id, id, active) > 0)
        pdf = (self._only or ds.emitter).pdf_direction(ref, ds, active & ~textured)
        if self._by_area:
            cosine = dr.abs(dr.dot(ds.d, ds.n))
            by_area = dr.gather(mi.Float, self._density, id, textured) * dr.square(ds.dist)
            pdf = dr.select(textured, dr.select(cosine > 0, by_area / cosine, 0), pdf)
        cell = dr.gather(mi.UInt32, self._first_cell, id, active)
        if not self._is_divided:
            return cell, dr.select(active, pdf, 0)
        if self._kinds - {"", "mesh"}:
            cell += self._grid_cell(id, ds, active)
        if "mesh" in self._kinds:
            is_mesh = active & (dr.gather(mi.UInt32, self._is_mesh, id, active) > 0)
            cell[is_mesh] = self._mesh_cell(id, si, is_mesh)
        if self.has_smooth_meshes:
            smooth = dr.gather(mi.UInt32, self._is_smooth, id, active) > 0
            pdf *= dr.select(smooth, _cosine_ratio(ds, si.n), 1)
        share = dr.gather(mi.Float, self._share, cell, active)
        # Masked lanes have the share 0
        return cell, dr.select(share > 0, pdf / share, 0)

    def _grid_cell(self, id, ds, active) -> mi.UInt32:
        """The cell of a point on a rectangle, disk or cylinder, as its index within the emitter."""
        columns = dr.gather(mi.UInt32, self._columns, id, active)
        rows = dr.gather(mi.UInt32, self._rows, id, active)
        x, y = ds.uv.x, ds.uv.y
        if "disk" in self._kinds or "cylinder" in self._kinds:
            shape = dr.gather(mi.UInt32, self._shape, id, active)
            sin, cos = dr.sincos(dr.two_pi * ds.uv.y)
            disk = mi.warp.uniform_disk_to_square_concentric(ds.uv.x * mi.Point2f(cos, sin))
            x, y = (
                dr.select(shape == 2, on_disk, dr.select(shape == 3, on_cylinder, uv))
                for on_disk, on_cylinder, uv in zip(disk, (ds.uv.y, ds.uv.x), ds.uv)
            )
        return _slot(x, columns) + columns * _slot(y, rows)

    def _mesh_cell(self, id, si, active) -> mi.UInt32:
        face = dr.gather(mi.UInt32, self._first_face, id, active) + si.prim_index
        entry = dr.gather(mi.UInt32, self._face_first, face, active)
        if self._has_cut_faces:
            cuts = dr.gather(mi.UInt32, self._face_cuts, face, active)
            a, ab, ac = (dr.gather(type(v), v, face, active) for v in (self._a, self._ab, self._ac))
            # Barycentric coordinates of the nearest point in the triangle's plane
            p = si.p - a
            d00, d01, d11 = dr.dot(ab, ab), dr.dot(ab, ac), dr.dot(ac, ac)
            d20, d21 = dr.dot(p, ab), dr.dot(p, ac)
            det = d00 * d11 - d01 * d01
            scale = dr.select(det > 0, dr.rcp(det), 0)
            u = dr.clip((d11 * d20 - d01 * d21) * scale, 0, 1)
            v = dr.clip((d00 * d21 - d01 * d20) * scale, 0, 1)
            # The inverse of square_to_uniform_triangle
            t = 1 - u
            x, y = 1 - t * t, dr.select(t > 0, v / t, 0)
            entry += _slot(x, cuts) + cuts * _slot(y, cuts)
        return dr.gather(mi.UInt32, self._cell_of_piece, entry, active)


def _sample_by_area(
    shape: mi.Shape,
    emitter: mi.Emitter,
    ref: mi.Interaction3f,
    sample: mi.Point2f,
    active: mi.Bool,
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """Samples a point uniformly on the emitter's shape; also returns its radiance / pdf."""
    ds = shape.sample_direction(ref, sample, active)
    value = emitter.eval_direction(ref, ds, active)
    return ds, dr.select(ds.pdf > 0, value / ds.pdf, 0)


def _area(shape: mi.Shape) -> float:
    return float(dr.slice(shape.surface_area()))


def _slot(x: mi.Float, count: mi.UInt32) -> mi.UInt32:
    """The index of the one of ``count`` equal parts of [0, 1] that holds ``x``."""
    return dr.minimum(mi.UInt32(dr.maximum(x, 0) * mi.Float(count)), count - 1)


def _cosine_ratio(ds: mi.DirectionSample3f, n: mi.Normal3f) -> mi.Float:
    """The factor that corrects a solid angle density that Mitsuba computed with the shading normal
    ``ds.n`` instead of the geometric normal ``n``."""
    cosine = dr.abs(dr.dot(ds.d, n))
    return dr.select(cosine > 0, dr.abs(dr.dot(ds.d, ds.n)) / cosine, 0)
