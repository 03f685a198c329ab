"""Sampling rays that leave lights, and the densities of these rays."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...scene.bounds import scene_bounds
from ...scene.bsdfs import bsdf_table, has_clear_curves
from ...transport.numbers import Numbers
from ...transport.scene_query import ray_starts
from .emitter_table import (
    AS_BEAM,
    CYLINDER,
    DISK,
    INFINITE,
    POINT,
    PROJECTOR,
    SPHERE,
    SPOT,
    TO_BOTH_SIDES,
    TRIANGLE,
    EmitterRow,
    EmitterTable,
    LightPieces,
    Piece,
)
from .light_directions import NOT_RECIPROCAL
from .stored_interaction import needs_whole_interaction

#: The fraction of the rays of a mesh light with interpolated normals that leave to the back of a
#: triangle.
_TO_BACK = 1 / 16

#: Rays start above a light by this fraction of Mitsuba's ray offset. Shadow rays end closer to the
#: light than the whole offset; with it, light paths would miss more of the surfaces near the light,
#: in scenes far from the origin.
_OFFSET = 0.05

#: The radius of the disks on which paths from lights at infinity begin, in units of the radius of
#: the scene's bounding sphere.
_MARGIN = 1.001


@dataclass
class EmittedRay:
    """A ray that leaves a light.

    Attributes:
        ray: The ray; its origin is offset from the surface.
        start: The interaction at the point on the light (normals, ``uv``, triangle, shape), with
            the direction of emission as ``wi``. For lights without surface only ``p``, time and
            wavelengths are meaningful.
        weight: Radiance · cosine / density.
        emitter, index: The emitter, and its number in ``scene.emitters()``.
        probability: Probability with which the emitter was chosen.
        pdf_position: Density of the point per area (of the light; for lights at infinity, of the
            disk perpendicular to the ray); 1 if the light is a point.
        pdf_direction: Density of the direction per solid angle; 1 if the light has only one
            direction; see :meth:`LightEmission.densities`.
        cosine: The cosine between the ray and the geometric normal, not negative; 1 for lights
            without surface.
        is_delta_position, is_delta_direction, is_infinite: The kind of light.
    """

    ray: mi.Ray3f
    start: mi.SurfaceInteraction3f
    weight: mi.Spectrum
    emitter: mi.EmitterPtr
    index: mi.UInt32
    probability: mi.Float
    pdf_position: mi.Float
    pdf_direction: mi.Float
    cosine: mi.Float
    is_delta_position: mi.Bool
    is_delta_direction: mi.Bool
    is_infinite: mi.Bool


class LightEmission:
    """Samples rays that leave the lights of a scene.

    It is correct for all emitters of Mitsuba 3.9.1, also where ``sample_ray`` is wrong (rotated
    spheres and environment maps, textures on rotated spheres and on meshes, interpolated normals,
    bounds of merged rectangles: ``docs/mitsuba_faults.md``). The radiance that leaves a surface is
    the value of ``emitter.eval`` for a ray that hits it. Points on a surface are uniformly
    distributed, even if it has a texture.

    Parameters:
        scene: A scene with at least one emitter.

    Attributes:
        needs_whole_interaction (bool): Whether stored vertices must hold all fields of the
            interaction (``stored_interaction.py``).
        not_reciprocal (mi.Bool | None): Which BSDFs are not reciprocal (``light_directions.py``).
        has_clear_curves (bool): Whether light passes through a curve (``scene/bsdfs.py``).
        probability (numpy.ndarray): Probability of choosing each emitter; shape [emitters].
        has_smooth_meshes (bool): Whether a light is a mesh with interpolated normals.
        radius (mi.Float): Approximate radius of the scene.

    Raises:
        NotImplementedError: Paths cannot start from one of the emitters.
    """

    def __init__(self, scene: mi.Scene) -> None:
        emitters = scene.emitters()
        # Computed once for a render, since it visits all shapes
        self.needs_whole_interaction = needs_whole_interaction(scene)
        self.not_reciprocal = bsdf_table(scene, NOT_RECIPROCAL)
        self.has_clear_curves = has_clear_curves(scene)
        self._pieces = LightPieces(scene)
        self.probability = self._pieces.probability
        self._emitters = scene.emitters_dr()
        flags = np.array([int(e.flags()) for e in emitters])
        self._delta_position, self._delta_direction, self._infinite = (
            flags & int(flag) != 0
            for flag in (mi.EmitterFlags.DeltaPosition, mi.EmitterFlags.DeltaDirection,
                         mi.EmitterFlags.Infinite)
        )  # fmt: skip
        kind = self._pieces.kind
        is_surface = kind <= CYLINDER
        self._has_surfaces = bool(is_surface.any())
        beams = np.flatnonzero(is_surface & self._delta_direction)
        self._beams = [(int(index), emitters[index]) for index in beams]
        self._has_beams = bool(self._beams)
        self.has_smooth_meshes = bool((self._pieces.way == TO_BOTH_SIDES).any())
        self._has_opposite_normals = self._pieces.has_opposite_normals
        self._kinds = set(kind.tolist())
        if self._has_beams and mi.is_spectral:
            raise NotImplementedError(
                'paths cannot start from the emitter "directionalarea" in spectral variants: it '
                "chooses its wavelengths itself"
            )
        self._starts = ray_starts(scene)
        box = scene_bounds(scene)
        sphere = box.bounding_sphere() if box.valid() else mi.ScalarBoundingSphere3f(0.0, 1.0)
        self._centre, self._radius = mi.Point3f(sphere.center), mi.Float(_MARGIN * sphere.radius)
        dr.make_opaque(self._centre, self._radius)
        self.radius = self._radius
        # No paths start from emitters of probability 0
        density = (self.probability > 0) / np.maximum(self._pieces.area, 1e-300)
        density[self._infinite] = 1 / (np.pi * (_MARGIN * sphere.radius) ** 2)
        density[self._delta_position] = 1
        self._table = EmitterTable(self._pieces, density, self._delta_direction, self._emitters)

    # ---- Sampling ----

    def sample(
        self,
        numbers: Numbers,
        time: mi.Float,
        wavelengths: mi.Spectrum,
        active: mi.Bool,
    ) -> EmittedRay:
        """Samples a ray. It draws three pairs of random numbers, for any kind of light.

        Parameters:
            numbers: The source of random numbers.
            time, wavelengths: Time and wavelengths of the ray.
        """
        piece = self._pieces.choose(numbers.next_2d(), active)
        u, v = numbers.next_2d(), numbers.next_2d()
        index = piece.emitter
        emitter = dr.gather(mi.EmitterPtr, self._emitters, index, active)
        row = self._table.row(index, active)
        is_surface = active & (piece.kind <= CYLINDER)
        ray = dr.zeros(mi.Ray3f, dr.width(index))
        ray.time, ray.wavelengths = time, wavelengths
        start = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
        start.time, start.wavelengths = time, wavelengths
        d, weight = mi.Vector3f(0, 0, 1), mi.Spectrum(0)
        pdf_direction, cosine = mi.Float(1), mi.Float(1)
        if self._has_surfaces:
            start, d, weight, pdf_direction, cosine = self._leave_surface(
                piece, emitter, ray, u, v, is_surface
            )
        if self._kinds - set(range(POINT)):
            p, other_d, other_weight, other_pdf = self._leave_nothing(
                piece, emitter, start, u, v, active & ~is_surface
            )
            start.p = dr.select(is_surface, start.p, p)
            d, weight, pdf_direction, cosine = (
                dr.select(is_surface, a, b)
                for a, b in ((d, other_d), (weight, other_weight), (pdf_direction, other_pdf),
                             (cosine, mi.Float(1)))
            )  # fmt: skip
        ray.o, ray.d, ray.maxt = start.p, d, dr.largest(mi.Float)
        if self._has_surfaces:
            share = 1.0 if self._starts.exact else _OFFSET
            above = dr.fma(share, self._starts.along(start, d).o - start.p, start.p)
            ray.o = dr.select(is_surface, above, ray.o)
        weight /= row.probability * row.density
        sound = active & dr.all(dr.isfinite(weight)) & (row.probability > 0)
        return EmittedRay(
            ray, start, dr.select(sound, weight, 0), emitter, index, row.probability, row.density,
            pdf_direction, cosine, *self._flags(piece.kind, row),
        )  # fmt: skip

    def _leave_surface(self, piece: Piece, emitter, ray, u, v, active):
        """Samples a point of an area light and a direction. Returns the interaction at the point,
        the direction, radiance · cosine / density of the direction, this density, and the
        cosine."""
        p, prim_uv = self._point(piece, u)
        si = self._found(piece, emitter, ray, p, prim_uv, active)
        is_back = mi.Bool(False)
        local = mi.warp.square_to_cosine_hemisphere(v)
        if self.has_smooth_meshes:
            is_smooth = piece.parameter == float(TO_BOTH_SIDES)
            is_back = is_smooth & (v.x < _TO_BACK)
            x = dr.select(is_back, v.x / _TO_BACK, (v.x - _TO_BACK) / (1 - _TO_BACK))
            turned = mi.warp.square_to_cosine_hemisphere(
                mi.Point2f(dr.select(is_smooth, x, v.x), v.y)
            )
            local = dr.select(is_back, mi.Vector3f(turned.x, turned.y, -turned.z), turned)
        if self._has_beams:
            is_beam = piece.parameter == float(AS_BEAM)
            local = dr.select(is_beam, mi.Vector3f(0, 0, 1), local)
        d, cosine = mi.Frame3f(self.front(si)).to_world(local), dr.abs(local.z)
        pdf = self._cosine_density(local.z, piece.parameter)
        si.wi = si.to_local(d)
        weight = emitter.eval(si, active) * dr.select(pdf > 0, cosine / pdf, 0)
        pdf = self._weighing_density(local.z, piece.parameter)
        if self._has_beams:
            pdf = dr.select(is_beam, 1, pdf)
            density = self._table.row(piece.emitter, active).density
            for index, light in self._beams:
                # A beam has no radiance to evaluate; the weight of ``sample_ray`` is radiance ·
                # area. This is no call of an ``EmitterPtr``, since other lights may have textures
                # that cannot be sampled
                mine = active & (piece.emitter == index)
                beam = light.sample_ray(ray.time, mi.Float(0.5), u, v, mine)[1]
                weight = dr.select(mine, beam * density, weight)
            cosine = dr.select(is_beam, 1, cosine)
        return si, d, weight, pdf, cosine

    def _point(self, piece: Piece, u: mi.Point2f) -> tuple[mi.Point3f, mi.Point2f]:
        """A point of a surface, and its ``prim_uv``."""
        x, y, z = u.x, u.y, mi.Float(0)
        prim_uv = mi.Point2f(u)

        def take(kind, *values):
            nonlocal x, y, z, prim_uv
            chosen = piece.kind == kind
            x, y, z = (dr.select(chosen, a, b) for a, b in zip(values, (x, y, z)))
            prim_uv = dr.select(chosen, mi.Point2f(values[0], values[1]), prim_uv)

        if TRIANGLE in self._kinds:
            t = mi.warp.square_to_uniform_triangle(u)
            take(TRIANGLE, t.x, t.y, mi.Float(0))
        if DISK in self._kinds:
            t = mi.warp.square_to_uniform_disk_concentric(u)
            take(DISK, t.x, t.y, mi.Float(0))
        if SPHERE in self._kinds:
            take(SPHERE, *mi.warp.square_to_uniform_sphere(u))
        if CYLINDER in self._kinds:
            sin, cos = dr.sincos(dr.two_pi * u.x)
            take(CYLINDER, cos, sin, u.y)
        return mi.Point3f(piece.point(x, y, z)), prim_uv

    def _found(self, piece, emitter, ray, p, prim_uv, active) -> mi.SurfaceInteraction3f:
        """The interaction of a ray that hits this point of a light."""
        pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(p))
        pi.prim_uv, pi.prim_index = prim_uv, piece.prim_index
        pi.shape, pi.valid = emitter.get_shape(), mi.Bool(active)
        pi.t = dr.select(active, mi.Float(0), dr.inf)
        ray = mi.Ray3f(ray)
        # The interaction does not depend on the direction, except ``wi``, which is set later
        ray.o, ray.d = p, mi.Vector3f(0, 0, 1)
        return pi.compute_surface_interaction(ray, mi.RayFlags.All, active)

    def _leave_nothing(self, piece: Piece, emitter, start, u, v, active):
        """Samples a ray of a light without surface. Returns its origin, its direction, radiance /
        density of the direction, and this density."""
        ref = mi.Interaction3f(start)
        p, d, pdf = mi.Point3f(piece.vector(0)), mi.Vector3f(0, 0, 1), mi.Float(1)
        is_infinite = piece.kind == INFINITE
        if POINT in self._kinds:
            is_point = piece.kind == POINT
            d = dr.select(is_point, mi.warp.square_to_uniform_sphere(v), d)
            pdf = dr.select(is_point, dr.inv_four_pi, pdf)
        if SPOT in self._kinds:
            is_spot = piece.kind == SPOT
            local = mi.warp.square_to_uniform_cone(v, dr.select(is_spot, piece.parameter, 0))
            d = dr.select(is_spot, piece.direction(*local), d)
            pdf = dr.select(is_spot, _cone_density(piece.parameter), pdf)
        if PROJECTOR in self._kinds:
            is_projector = piece.kind == PROJECTOR
            through = piece.direction(2 * v.x - 1, 2 * v.y - 1, mi.Float(1))
            # The axis has length 1, so that the cosine with it is 1 / distance
            distance = dr.norm(dr.select(is_projector, through, mi.Vector3f(0, 0, 1)))
            d = dr.select(is_projector, through / distance, d)
            area = dr.select(is_projector, piece.parameter, 1)
            pdf = dr.select(is_projector, distance**3 / area, pdf)
        # The reference point is far away, so that rounding does not change the direction
        ref.p = dr.select(is_infinite, self._centre, p + self._radius * d)
        ds, weight = emitter.sample_direction(ref, v, active)
        weight = dr.select(is_infinite, weight, weight * (dr.square(ds.dist) / pdf))
        if INFINITE in self._kinds:
            d = dr.select(is_infinite, -ds.d, d)
            pdf = dr.select(is_infinite, ds.pdf, pdf)
            disk = mi.warp.square_to_uniform_disk_concentric(u)
            side = mi.Frame3f(ds.d).to_world(mi.Vector3f(disk.x, disk.y, 1))
            p = dr.select(is_infinite, self._centre + self._radius * side, p)
        return p, d, dr.select(active & (ds.pdf > 0), weight, 0), pdf

    # ---- Densities ----

    def densities(
        self,
        scene: mi.Scene,
        emitter: mi.EmitterPtr,
        d: mi.Vector3f,
        n: mi.Normal3f,
        ref: mi.Interaction3f,
        active: mi.Bool,
        knows_normal: bool = False,
    ) -> tuple[mi.Float, mi.Float]:
        """The densities with which :meth:`sample` finds a ray that another technique has found, for
        MIS weights. Where normals are interpolated, both sides of a triangle have the density of
        its front, since next event estimation does not know the triangle's normal.

        Parameters:
            emitter: The light.
            d: The direction of emission.
            n: Normal of the light where the ray leaves it: :meth:`front`, or the shading normal
                where only that is known.
            ref: A point that the light illuminates; used for lights at infinity only.
            knows_normal: Whether ``n`` is always the normal of the triangle. The densities are then
                exactly the densities of :meth:`sample`.

        Returns:
            ``probability · pdf_position`` and ``pdf_direction``, as in :class:`EmittedRay`.
        """
        index = self.index(emitter, active)
        row = self._table.row(index, active)
        pdf = mi.Float(1)
        if self._has_surfaces:
            leaves = self._cosine_density if knows_normal else self._weighing_density
            pdf = dr.select(row.kind <= CYLINDER, leaves(dr.dot(n, d), row.way), pdf)
        if POINT in self._kinds:
            pdf = dr.select(row.kind == POINT, dr.inv_four_pi, pdf)
        if SPOT in self._kinds:
            inside = dr.dot(d, row.axis) >= row.parameter
            spot = dr.select(inside, _cone_density(row.parameter), 0)
            pdf = dr.select(row.kind == SPOT, spot, pdf)
        if PROJECTOR in self._kinds:
            cosine = dr.dot(d, row.axis)
            image = dr.select(cosine > 0, dr.rcp(row.parameter * cosine**3), 0)
            pdf = dr.select(row.kind == PROJECTOR, image, pdf)
        if INFINITE in self._kinds:
            is_infinite = row.kind == INFINITE
            ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
            ds.d, ds.emitter = -d, emitter
            sky = emitter.pdf_direction(ref, ds, active & is_infinite & ~row.is_beam)
            pdf = dr.select(is_infinite, sky, pdf)
        pdf = dr.select(row.is_beam, 1, pdf)
        known = active & (emitter != None)  # noqa: E711
        return dr.select(known, row.probability * row.density, 0), dr.select(known, pdf, 0)

    def front(self, si: mi.SurfaceInteraction3f) -> mi.Normal3f:
        """The geometric normal on the side to which a light emits: the side of the shading normal.
        The two are opposite where ``to_world`` mirrors a mesh."""
        if not self._has_opposite_normals:
            return si.n
        return dr.select(dr.dot(si.n, si.sh_frame.n) < 0, -si.n, si.n)

    def chance(self, index: mi.UInt32, active: mi.Bool) -> mi.Float:
        """See :meth:`.EmitterTable.chance`."""
        return self._table.chance(index, active)

    def index(self, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.UInt32:
        """See :meth:`.EmitterTable.index`."""
        return self._table.index(emitter, active)

    def _cosine_density(self, cosine: mi.Float, way: mi.Float) -> mi.Float:
        """The density of a direction of emission that has this cosine with the normal."""
        front = dr.maximum(cosine, 0) * dr.inv_pi
        both = dr.select(cosine < 0, -_TO_BACK, 1 - _TO_BACK) * cosine * dr.inv_pi
        return dr.select(way == float(TO_BOTH_SIDES), both, front)

    def _weighing_density(self, cosine: mi.Float, way: mi.Float) -> mi.Float:
        """Like :meth:`_cosine_density`, for MIS weights: see :meth:`densities`."""
        is_smooth = self.has_smooth_meshes & (way == float(TO_BOTH_SIDES))
        return self._cosine_density(dr.select(is_smooth, dr.abs(cosine), cosine), way)

    def _flags(self, kind: mi.UInt32, row: EmitterRow) -> tuple[mi.Bool, mi.Bool, mi.Bool]:
        is_point = (kind >= POINT) & (kind <= PROJECTOR)
        return is_point, row.is_beam, kind == INFINITE


def _cone_density(cos_cutoff: mi.Float) -> mi.Float:
    return dr.inv_two_pi * dr.rcp(dr.maximum(1 - cos_cutoff, 1e-7))
